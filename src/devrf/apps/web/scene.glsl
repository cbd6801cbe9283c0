// What a pixel sees of the scene at one time. Names after "docs/method.md" are anchors there.
//
// Defined before: SPACE (0 the world, 1 NDC, 2 contracted); EXACT (1: all samples, their colours by
// the network; 0, preview: fewer, the same from all sides); FEATURES and WIDTH (vec4s of a sample's
// features and of a hidden layer); FREQUENCIES (octaves of the direction); MOVES and RESIDUAL
// (whether there are displacements, and residual colours).

precision highp float;
precision highp int;
precision highp sampler3D;
precision highp usampler3D;

// Channels. A probe is how far a ray gets, a float's four bytes, for the page to read.
const int COLOR = 0, DEPTH = 1, MOTION = 2, PROBE = 3;
// A ray ends where its transmittance is less. A preview has fewer samples.
const float STOP = EXACT == 1 ? 1e-4 : 1e-2;
const float STRIDE = EXACT == 1 ? 1.0 : 2.0;
// Points nearer to infinity are taken to be at this distance from it.
const float GAP = 1e-6;
// Motion is shown over this share of all time, saturated at this share of the picture's height.
const float MOTION_STEP = 0.05, MOTION_FULL = 0.02;

// Of all grids z is along the texture's width and x along its depth, as they lie in memory.
uniform sampler3D density, features, weights;   // features: blocks of four channels
uniform sampler3D rough;                        // preview colours
uniform sampler3D moving;                       // 1 where canonical points move
uniform sampler3D palette;                      // colours of depths, from near to far
uniform sampler3D displacement0, displacement1, residual0, residual1; // before, after the time
uniform usampler3D distances;
uniform vec3 low, high, displacementLow, displacementHigh;  // the boxes of all fields, and of displacements
uniform float shift, delta, threshold, stepLength, near, far, displacementStep;
uniform vec3 ndc;                    // 2f/W, 2f/H, near plane
uniform vec3 center, innerHalf;      // of the scene; in contracted space of the inner box
uniform float reach, shell;          // of depths about the centre, in the world; of contracted space
uniform bool warps, zeroOutsideBox;
uniform float share, interval;       // of the frame after; from one to the other
uniform vec3 eye, right, up, backward, background;
uniform vec2 slope, middle;          // tangents of half the angles of view, of its middle's angles
uniform vec4 frame;                  // x, y, width and height of the picture, in pixels
uniform int channel, part;           // part: 1 shows what moves alone, 2 what stays
out vec4 pixel;

float largest(vec3 v) { return max(v.x, max(v.y, v.z)); }

// Rays: docs/method.md#rays, #forward-facing, #scene-contraction.
struct Ray { vec3 origin, direction, course; }; // course: of a contracted ray x_o, k and beta

Ray fieldRay(vec3 direction) {
#if SPACE == 1
  vec3 start = eye - direction * ((ndc.z + eye.z) / direction.z);
  vec2 across = -ndc.xy * (direction.xy / direction.z - start.xy / start.z);
  vec3 origin = vec3(-ndc.xy * start.xy / start.z, 1.0 + 2.0 * ndc.z / start.z);
  return Ray(origin, vec3(across, -2.0 * ndc.z / start.z), vec3(0.0));
#elif SPACE == 2
  vec3 start = (eye - center) / innerHalf;
  vec3 pace = direction / innerHalf;
  vec3 size = abs(pace);
  int axis = size.x == largest(size) ? 0 : size.y == largest(size) ? 1 : 2;
  float sideways = largest(abs(pace * start[axis] - start * pace[axis])) / size[axis];
  float beta = max(0.5 * (1.0 + shell) * sideways, shell);
  return Ray(eye, direction, vec3(start[axis] * sign(pace[axis]), size[axis], beta));
#endif
  return Ray(eye, direction, vec3(0.0));
}

// A contracted ray's own distance s of a world distance t, and back.
float ownDistance(Ray ray, float t) {
  float x = ray.course.x + ray.course.y * t;
  float y = sign(x) * (1.0 + ray.course.z * (1.0 - 1.0 / max(abs(x), 1.0)));
  return abs(x) > 1.0 ? (y - ray.course.x) / ray.course.y : t;
}

float worldDistance(Ray ray, float s) {
  float y = ray.course.x + ray.course.y * s;
  float left = max(1.0 - (abs(y) - 1.0) / ray.course.z, GAP);
  return abs(y) > 1.0 ? (sign(y) / left - ray.course.x) / ray.course.y : s;
}

vec3 at(Ray ray, float s) {
  if (SPACE != 2) return ray.origin + ray.direction * s;
  vec3 u = (ray.origin + ray.direction * worldDistance(ray, s) - center) / innerHalf;
  float m = max(largest(abs(u)), 1.0);
  return center + innerHalf * u * ((1.0 + shell - shell / m) / m);
}

vec3 toWorld(vec3 point) {
  float depth = 2.0 * ndc.z / min(point.z - 1.0, -GAP);
  if (SPACE == 1) return vec3(-point.xy * depth / ndc.xy, depth);
  vec3 u = (point - center) / innerHalf;
  float m = max(largest(abs(u)), 1.0);
  float left = max(1.0 + shell - m, GAP * shell);
  return SPACE == 2 ? center + innerHalf * u * (shell / left / m) : point;
}

// Fields: docs/method.md#canonical-field, #warp, #color-residual, #occupancy. A point's place in the
// texture of a grid whose outer points lie on a box:
vec3 place(vec3 point, vec3 boxLow, vec3 boxHigh, ivec3 size) {
  vec3 inside = clamp((point - boxLow) / (boxHigh - boxLow), 0.0, 1.0).zyx;
  return (inside * vec3(size - 1) + 0.5) / vec3(size);
}

vec3 displacement(vec3 point, float after) {
  bool outside = any(lessThan(point, displacementLow)) || any(greaterThan(point, displacementHigh));
  if (MOVES == 0 || zeroOutsideBox && outside) return vec3(0.0);
  vec3 p = place(point, displacementLow, displacementHigh, textureSize(displacement0, 0));
  vec4 steps = mix(textureLod(displacement0, p, 0.0), textureLod(displacement1, p, 0.0), after);
  return displacementStep * steps.xyz;
}

vec3 residual(vec3 canonical) {
  if (RESIDUAL == 0 || !warps) return vec3(0.0);
  vec3 p = place(canonical, low, high, textureSize(residual0, 0));
  return mix(textureLod(residual0, p, 0.0), textureLod(residual1, p, 0.0), share).xyz;
}

// Cells to the nearest occupied one, at least; 0 in an occupied cell.
int clearance(vec3 point) {
  ivec3 size = textureSize(distances, 0);
  vec3 inside = ((point - low) / (high - low)).zyx;
  ivec3 cell = ivec3(floor(inside * vec3(size - 1) + 0.5));
  bool outside = any(lessThan(cell, ivec3(0))) || any(greaterThanEqual(cell, size));
  return outside ? 1 : int(texelFetch(distances, cell, 0).r);
}

// Colour network: docs/method.md#colour. Groups of three numbers of the direction; parts' places.
// Of each part come numbers for all outputs, input after input; biases take four inputs' place.
const int GROUPS = 1 + 2 * FREQUENCIES;
const int FROM_FEATURES = 4 * WIDTH;
const int FROM_DIRECTION = FROM_FEATURES + 4 * WIDTH * FEATURES;
const int HIDDEN_BIAS = FROM_DIRECTION + WIDTH * ((3 * GROUPS + 3) / 4 * 4);
const int HIDDEN = HIDDEN_BIAS + 4 * WIDTH;
const int OUTPUT_BIAS = HIDDEN + 4 * WIDTH * WIDTH;
const int OUTPUT = OUTPUT_BIAS + 4;

vec4 number(int k) { return texelFetch(weights, ivec3(k & 63, k >> 6, 0), 0); }
mat4 block(int k, int outputs) {
  return mat4(number(k), number(k + outputs), number(k + 2 * outputs), number(k + 3 * outputs));
}

// What the first layer gets from the direction: the same for all samples of a ray.
vec4 fromRay[WIDTH];

void encode(vec3 direction) {
  vec3 code[GROUPS];
  code[0] = direction;
  for (int k = 0; k < FREQUENCIES; k++) {
    code[1 + k] = sin(exp2(float(k)) * direction);
    code[1 + FREQUENCIES + k] = cos(exp2(float(k)) * direction);
  }
  for (int j = 0; j < WIDTH; j++) {
    fromRay[j] = number(j);
    for (int group = 0; group < GROUPS; group++) {
      int k = FROM_DIRECTION + 3 * group * WIDTH + j;
      fromRay[j] += mat3x4(number(k), number(k + WIDTH), number(k + 2 * WIDTH)) * code[group];
    }
  }
}

vec3 network(vec3 p, vec3 added) {
  vec4 feature[FEATURES];
  for (int c = 0; c < FEATURES; c++) {
    feature[c] = textureLod(features, vec3(p.xy, (p.z + float(c)) / float(FEATURES)), 0.0);
  }
  vec4 hidden[WIDTH];
  for (int i = 0; i < WIDTH; i++) hidden[i] = number(HIDDEN_BIAS + i);
  for (int j = 0; j < WIDTH; j++) {
    vec4 unit = fromRay[j];
    for (int c = 0; c < FEATURES; c++) {
      unit += block(FROM_FEATURES + 4 * c * WIDTH + j, WIDTH) * feature[c];
    }
    unit = max(unit, 0.0);
    for (int i = 0; i < WIDTH; i++) hidden[i] += block(HIDDEN + 4 * j * WIDTH + i, WIDTH) * unit;
  }
  vec4 logits = number(OUTPUT_BIAS);
  for (int i = 0; i < WIDTH; i++) logits += block(OUTPUT + 4 * i, 1) * max(hidden[i], 0.0);
  return 1.0 / (1.0 + exp(-(logits.xyz + added)));
}

// Between the depths of geometry/space.py's depth_range.
vec3 depthColor(float s, float opacity) {
#if SPACE == 1
  float first = near, last = far;
#elif SPACE == 2
  float away = largest(abs(eye - center) / innerHalf), unit = dot(innerHalf, vec3(1.0 / 3.0));
  float first = unit * max(away - 1.0 - shell * (1.0 - 1.0 / max(away, 1.0)), 0.0);
  float last = unit * (away + 1.0 + shell);
#else
  float first = max(length(eye - center) - reach, 0.0), last = length(eye - center) + reach;
#endif
  float behind = clamp((s - first) / (last - first), 0.0, 1.0);
  vec3 look = texelFetch(palette, ivec3(1.0 + 254.0 * behind, 0, 0), 0).rgb; // the stills' steps
  return mix(vec3(1.0), look, opacity);
}

vec2 onPicture(vec3 point) {
  vec3 away = toWorld(point) - eye;
  return vec2(dot(away, right), dot(away, up)) / (-2.0 * slope.y * dot(away, backward));
}

// Optical flow of a point x: hue is direction, saturation length. Its canonical position q is a
// little later at the x' with x' + D(x') = q, which two steps of a fixed point find.
vec3 motionColor(vec3 x) {
  float later = share + (share < 0.5 ? 0.25 : -0.25);
  vec3 q = x + displacement(x, share);
  vec3 moved = q - displacement(q - displacement(x, later), later);
  vec2 flow = (onPicture(moved) - onPicture(x)) * MOTION_STEP / (interval * (later - share));
  float saturation = clamp(length(flow) / MOTION_FULL, 0.0, 1.0);
  float hue = saturation > 0.0 ? atan(flow.y, flow.x) / 6.2831853 : 0.0;
  vec3 pure = clamp(abs(fract(hue + vec3(3.0, 2.0, 1.0) / 3.0) * 6.0 - 3.0) - 1.0, 0.0, 1.0);
  return (1.0 - 0.1 * saturation) * mix(vec3(1.0), pure, saturation);
}

// Pixels: docs/method.md#compositing.
void main() {
  vec2 onScreen = middle + slope * (2.0 * (gl_FragCoord.xy - frame.xy) / frame.zw - 1.0);
  vec3 direction = normalize(right * onScreen.x + up * onScreen.y - backward);
  Ray ray = fieldRay(direction);
  vec3 cells = vec3(textureSize(distances, 0).zyx - 1) / (high - low);
#if SPACE == 2
  float entry = ownDistance(ray, near);
  float leave = ownDistance(ray, far);
  // At most so many cells in a unit of its distance (kernels/march.py).
  vec3 size = abs(direction / innerHalf);
  float pace = 2.0 * (size.x + size.y + size.z) - ray.course.y;
  pace = max(pace, max(3.0, shell) * ray.course.y) * largest(innerHalf * cells);
#else
  vec3 safe = mix(ray.direction, vec3(1e-9), lessThan(abs(ray.direction), vec3(1e-9)));
  vec3 toLow = (low - ray.origin) / safe, toHigh = (high - ray.origin) / safe;
  vec3 exit = max(toLow, toHigh);
  // From so far away that nothing would be sampled rays begin at the box.
  bool apart = SPACE == 0 && length(max(abs(eye - low), abs(eye - high))) > far;
  float entry = max(near, largest(min(toLow, toHigh)));
  float leave = min(apart ? 1e9 : far, min(exit.x, min(exit.y, exit.z)));
  float pace = largest(abs(ray.direction) * cells);
#endif
  float stride = STRIDE * stepLength;
  bool meets = leave >= entry && (SPACE != 1 || direction.z < -1e-3); // or no near plane is crossed
  int count = meets ? int(floor((leave - entry) / stride + 1e-3)) + 1 : 0;
  float samplesPerCell = 0.999 / max(pace * stride, 1e-9);

  vec3 color = vec3(0.0);
  float transmittance = 1.0, mass = 0.0, reached = 0.0;
  if (EXACT == 1 && channel == COLOR && count > 0) encode(direction);
  for (int k = 0; true; k++) {
    float s = 0.0;
    for (; k < count; k++) {
      s = entry + float(k) * stride;
      int away = clearance(at(ray, s));
      if (away == 0) break;
      // In away - 1 cells' way the nearest cell changes by less than that and one.
      k += int(float(away - 1) * samplesPerCell);
    }
    bool ends = k >= count || transmittance < STOP;
    vec3 p, canonical, added = vec3(0.0);
    float weight = transmittance;
    if (ends) {
      if (SPACE != 2 || channel != COLOR) break;
      canonical = at(ray, ownDistance(ray, 1e30)); // the field's own colour at infinity
      p = place(canonical, low, high, textureSize(density, 0));
    } else {
      canonical = at(ray, s);
      if (warps) canonical += displacement(canonical, share);
      p = place(canonical, low, high, textureSize(density, 0));
      if (part > 0 && part != (textureLod(moving, p, 0.0).r > 0.5 ? 1 : 2)) continue;
      float raw = textureLod(density, p, 0.0).r + shift;
      float alpha = 1.0 - exp(-STRIDE * delta * (raw > 15.0 ? raw : log(1.0 + exp(raw))));
      if (alpha < threshold) continue;
      weight *= alpha;
      transmittance *= 1.0 - alpha;
      if (weight < threshold) continue;
      mass += weight;
      reached += weight * s;
      if (channel != COLOR) continue;
      added = residual(canonical);
    }
#if EXACT
    color += weight * network(p, added);
#else
    vec3 look = textureLod(rough, p, 0.0).rgb;
    color += weight * look / (look + (1.0 - look) * exp(-added)); // added to the logit
#endif
    if (ends) break;
  }
  if (SPACE != 2) color += transmittance * background;

  float s = reached / max(mass, 1e-6);
  float opacity = 1.0 - transmittance;
  if (channel == DEPTH) color = depthColor(s, opacity);
  if (channel == MOTION) color = opacity > 0.5 ? motionColor(at(ray, s)) : vec3(0.85);
  uint bits = floatBitsToUint(opacity > 0.5 ? length(toWorld(at(ray, s)) - eye) : 0.0);
  uvec4 bytes = uvec4(bits) >> uvec4(0, 8, 16, 24) & 255u;
  pixel = channel == PROBE ? vec4(bytes) / 255.0 : vec4(color, 1.0);
}
