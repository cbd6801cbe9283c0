// Draws the scene that this page holds, and lets people fly through it.
//
// Data are gzipped text in script elements (pack.py). They become textures, and scene.glsl follows
// a ray through these for every pixel. Units are the world's, and radians.

// Milliseconds a picture while something moves, its fewest rows, and the wait for finer ones then.
const BUDGET = 70;
const MIN_ROWS = 72;
const SETTLED = 120;
// Seconds from time 0 to 1 at speed 1, and of a whole turn.
const DURATION = 5;
const TURN = 20;
const DAMAGED = "This file is damaged or incomplete: copy or export it again";

const root = document.documentElement;
const byId = (id) => document.getElementById(id);
const within = (value, low, high) => Math.min(Math.max(value, low), high);
const scaled = (a, factor) => a.map((value) => value * factor);
const along = (a, factor, b) => a.map((value, axis) => value + factor * b[axis]);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) =>
  [0, 1, 2].map((k) => a[(k + 1) % 3] * b[(k + 2) % 3] - a[(k + 2) % 3] * b[(k + 1) % 3]);
const unit = (a) => scaled(a, 1 / Math.hypot(...a));

/** Ends the page with one line in the picture's place. */
function fail(error) {
  if (document.body.className === "failed") return;
  document.body.className = "failed";
  byId("message").textContent = `The scene cannot be shown. ${error?.message ?? error}`;
}

/** The bytes that an element of the page holds; gzip has a checksum of them. */
async function inflate(id) {
  try {
    const letters = atob(byId(id).textContent);
    const packed = new Uint8Array(letters.length);
    for (let k = 0; k < letters.length; k++) packed[k] = letters.charCodeAt(k);
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
    return await new Response(stream).arrayBuffer();
  } catch {
    throw new Error(`${DAMAGED} (${id}).`);
  }
}

// Of each kind of data: format in the texture and in memory, and what holds its numbers.
const KINDS = {
  density: ["R16F", "RED", "HALF_FLOAT", Uint16Array],
  rough: ["RGB8", "RGB", "UNSIGNED_BYTE", Uint8Array],
  features: ["RGBA8", "RGBA", "UNSIGNED_BYTE", Uint8Array],
  weights: ["RGBA32F", "RGBA", "FLOAT", Float32Array],
  moving: ["R8", "RED", "UNSIGNED_BYTE", Uint8Array],
  palette: ["RGB8", "RGB", "UNSIGNED_BYTE", Uint8Array],
  distances: ["R8UI", "RED_INTEGER", "UNSIGNED_BYTE", Uint8Array],
  displacement: ["RGB16F", "RGB", "HALF_FLOAT", Uint16Array],
  residual: ["RGB16F", "RGB", "HALF_FLOAT", Uint16Array],
};
// Textures by their units' numbers: six that stay; of what changes one before the time, one after.
const UNITS = ["density", "rough", "features", "weights", "moving", "palette", "distances"];
UNITS.push("rest", "displacement0", "displacement1", "residual0", "residual1");
const [DISTANCES, REST] = [6, 7];

class Graphics {
  constructor(canvas, scene) {
    // What was drawn stays: pictures are refined row by row, and read by programs.
    const options = { antialias: false, alpha: false, depth: false, preserveDrawingBuffer: true };
    const gl = canvas.getContext("webgl2", options);
    if (!gl) {
      throw new Error("There is no WebGL 2: allow hardware acceleration, or update the browser.");
    }
    canvas.addEventListener("webglcontextlost", () => {
      fail(new Error("The graphics driver has given up (lost context): reload the page."));
    });
    Object.assign(this, { canvas, scene, gl, programs: [], target: gl.createFramebuffer() });
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    const buffer = gl.createRenderbuffer();
    gl.bindRenderbuffer(gl.RENDERBUFFER, buffer);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.RENDERBUFFER, buffer);
  }

  /** The program for the exact picture (1), or for the preview (0). */
  program(exact) {
    const { gl, scene } = this;
    if (this.programs[exact]) return this.programs[exact];
    const values = Object.entries({ ...scene.defines, EXACT: exact });
    const defines = values.map(([name, value]) => `#define ${name} ${value}\n`).join("");
    const triangle = "vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0";
    const vertices = `void main() { gl_Position = vec4(${triangle}, 0.0, 1.0); }`;
    const handle = gl.createProgram();
    const shaders = [gl.VERTEX_SHADER, gl.FRAGMENT_SHADER].map((kind) => gl.createShader(kind));
    [vertices, defines + byId("shader").textContent].forEach((source, k) => {
      gl.shaderSource(shaders[k], `#version 300 es\n${source}`);
      gl.compileShader(shaders[k]);
      gl.attachShader(handle, shaders[k]);
    });
    gl.linkProgram(handle);
    if (!gl.getProgramParameter(handle, gl.LINK_STATUS) && !gl.isContextLost()) {
      const why = gl.getShaderInfoLog(shaders[1]) || gl.getProgramInfoLog(handle);
      throw new Error(`The graphics driver refuses the program: ${why.split("\n")[0]}`);
    }
    const uniforms = {};
    for (let k = 0; k < gl.getProgramParameter(handle, gl.ACTIVE_UNIFORMS); k++) {
      const { name, type } = gl.getActiveUniform(handle, k);
      uniforms[name.replace("[0]", "")] = [gl.getUniformLocation(handle, name), type];
    }
    // Milliseconds a pixel; a guess, until it was measured.
    const cost = exact ? 20 * this.programs[0].cost : 1e-3;
    const program = { handle, uniforms, cost, warm: false };
    this.programs[exact] = program;
    gl.useProgram(handle);
    UNITS.forEach((name, k) => this.set(program, { [name]: k }));
    this.set(program, scene.uniforms);
    return program;
  }

  /** Sets uniforms of the program in use, by name; those that it does not have are left out. */
  set({ uniforms }, values) {
    const { gl } = this;
    for (const [name, value] of Object.entries(values)) {
      const [place, type] = uniforms[name] ?? [null, null];
      if (type === gl.FLOAT) gl.uniform1f(place, value);
      else if (type === gl.FLOAT_VEC2) gl.uniform2fv(place, value);
      else if (type === gl.FLOAT_VEC3) gl.uniform3fv(place, value);
      else if (type === gl.FLOAT_VEC4) gl.uniform4fv(place, value);
      else if (place) gl.uniform1i(place, value);
    }
  }

  /** Fills the texture of a unit. */
  fill(name, kind, data) {
    const { gl, scene } = this;
    const [internal, format, type, Numbers] = KINDS[kind];
    const size = scene.shapes[kind];
    gl.activeTexture(gl.TEXTURE0 + UNITS.indexOf(name));
    if (!gl.getParameter(gl.TEXTURE_BINDING_3D)) {
      const filter = ["distances", "weights"].includes(kind) ? gl.NEAREST : gl.LINEAR;
      gl.bindTexture(gl.TEXTURE_3D, gl.createTexture());
      gl.texStorage3D(gl.TEXTURE_3D, 1, gl[internal], ...size);
      gl.texParameteri(gl.TEXTURE_3D, gl.TEXTURE_MIN_FILTER, filter);
      gl.texParameteri(gl.TEXTURE_3D, gl.TEXTURE_MAG_FILTER, filter);
    }
    const numbers = new Numbers(data);
    gl.texSubImage3D(gl.TEXTURE_3D, 0, 0, 0, 0, ...size, gl[format], gl[type], numbers);
    if (gl.getError() && !gl.isContextLost()) {
      throw new Error("The scene is too large for this graphics driver, or its memory is full.");
    }
  }

  /** Brings onto the device what is the same at all times. */
  async load() {
    for (const kind of UNITS.slice(0, 6)) this.fill(kind, kind, await inflate(kind));
    this.fill("rest", "distances", await inflate("distances-rest"));
  }

  /** Draws into a part of the target; "frame" is where the whole picture would lie. */
  paint(program, uniforms, frame, [x, y, width, height]) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.useProgram(program.handle);
    gl.viewport(x, y, width, height);
    this.set(program, { ...uniforms, frame });
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /** Draws rows of pictures side by side, counted from below, and shows them on all the canvas. */
  draw(program, parts, width, height, first, last) {
    const { gl, canvas } = this;
    const scale = canvas.height / height;
    // Where a picture is enlarged, its edges are mixed with the pixels beyond them.
    const beyond = scale > 1 ? 1 : 0;
    parts.forEach((uniforms, k) => {
      const left = Math.round((k * width) / parts.length);
      const wide = Math.round(((k + 1) * width) / parts.length) - left;
      const drawn = [left, first, wide + beyond, last - first + beyond];
      this.paint(program, uniforms, [left, 0, wide, height], drawn);
    });
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, null);
    const [from, to] = [[0, first, width, last], [0, first * scale, canvas.width, last * scale]];
    const filter = scale > 1 ? gl.LINEAR : gl.NEAREST;
    gl.blitFramebuffer(...from, ...to, gl.COLOR_BUFFER_BIT, filter);
    const sync = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    this.pending = { sync, program, pixels: width * (last - first), began: performance.now() };
  }

  /** Whether nothing is being drawn; a program's cost is what its last picture took. */
  get idle() {
    const { gl, pending } = this;
    if (!pending) return true;
    if (gl.clientWaitSync(pending.sync, 0, 0) === gl.TIMEOUT_EXPIRED) return false;
    gl.deleteSync(pending.sync);
    const { program, began, pixels } = pending;
    // With the first picture drivers finish compiling.
    if (program.warm) program.cost = (performance.now() - began) / pixels;
    program.warm = true;
    this.pending = null;
    return true;
  }

  /** How far the ray gets through the lower left corner, in world units; 0 if it meets nothing. */
  reach(uniforms, frame) {
    const { gl } = this;
    this.paint(this.program(0), { ...uniforms, channel: 3 }, frame, [0, 0, 1, 1]);
    const pixel = new Float32Array(1);
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(pixel.buffer));
    return pixel[0];
  }
}

/** The fields that change: two frames are on the device, the others stay packed. */
class Deformation {
  constructor(graphics, { times, shapes }) {
    Object.assign(this, { graphics, times, interval: -1, packed: {}, moves: times.length > 1 });
    this.kinds = ["displacement", "residual"].filter((kind) => shapes[kind]);
  }

  /** Units, kinds and elements of what lies around an interval between two frames. */
  around(interval) {
    const frames = [0, 1].flatMap((k) => this.kinds.map((kind) => [kind + k, kind, interval + k]));
    const all = [["distances", "distances", interval], ...frames];
    return all.map(([name, kind, number]) => [name, kind, `${kind}-${number}`]);
  }

  /** Brings the two frames around a time onto the device, and unpacks the one after them. */
  async load(time) {
    const later = this.times.findIndex((frame) => frame > time);
    const interval = (later < 0 ? this.times.length : later + 1) - 2;
    if (!this.moves || this.loading || interval === this.interval) return;
    this.loading = true;
    const now = this.around(interval);
    const next = this.around(interval + 1).filter(([, , id]) => byId(id));
    const ids = [...now, ...next].map(([, , id]) => id);
    this.packed = Object.fromEntries(ids.map((id) => [id, this.packed[id] ?? inflate(id)]));
    const data = await Promise.all(now.map(([, , id]) => this.packed[id]));
    now.forEach(([name, kind], k) => this.graphics.fill(name, kind, data[k]));
    // The device has the frame before: what comes next begins with the one after.
    this.packed = Object.fromEntries(next.map(([, , id]) => [id, this.packed[id]]));
    Object.assign(this, { interval, loading: false });
  }

  /** Uniforms of a time, or of the nearest one between the frames on the device. */
  uniforms(time) {
    if (this.interval < 0) return { warps: false, share: 0, interval: 1, distances: REST };
    const [before, after] = this.times.slice(this.interval);
    const share = within((time - before) / (after - before), 0, 1);
    return { warps: true, share, interval: after - before, distances: DISTANCES };
  }
}

/**
 * A pinhole camera that looks at a target: { right, up, backward, target, distance, fov, middle }.
 * The middle of its picture is off its axis by these tangents, to the right and upwards.
 */
class Camera {
  constructor(values) {
    Object.assign(this, values);
  }

  /** Of a camera-to-world pose of 12 numbers, OpenGL axes. */
  static of({ pose, distance, fov, middle }) {
    const [right, up, backward, eye] = [0, 1, 2, 3].map((k) => [pose[k], pose[k + 4], pose[k + 8]]);
    const target = along(eye, -distance, backward);
    return new Camera({ right, up, backward, target, distance, fov, middle });
  }

  get eye() {
    return along(this.target, this.distance, this.backward);
  }

  /** Turned about an upward axis, and nearer to it or farther, but not over it. */
  turned(yaw, pitch, axis) {
    const about = (v, n, angle) => {
      const [c, s] = [Math.cos(angle), Math.sin(angle)];
      return along(along(scaled(v, c), s, cross(n, v)), (1 - c) * dot(n, v), n);
    };
    const level = [this.right, this.up, this.backward].map((v) => about(v, axis, yaw));
    const tilted = level.map((v) => about(v, level[0], -pitch));
    const over = Math.abs(dot(tilted[2], axis)) > Math.max(0.998, Math.abs(dot(level[2], axis)));
    const [right, up, backward] = over ? level : tilted;
    return new Camera({ ...this, right, up, backward });
  }

  /** Moved with its target along its axes, by shares of the distance. */
  moved(x, y, z) {
    const { distance, right, up, backward } = this;
    const across = along(along(this.target, x * distance, right), y * distance, up);
    return new Camera({ ...this, target: along(across, z * distance, backward) });
  }
}

class Page {
  constructor(scene, graphics) {
    const camera = Camera.of(scene.cameras[0]);
    Object.assign(this, { scene, graphics, camera, time: 0, last: 0, refined: 0, shown: [] });
    this.deformation = new Deformation(graphics, scene);
    this.keys = new Set();
    const frustum = byId("frusta").firstElementChild;
    this.frusta = scene.cameras.map(() => frustum.cloneNode(true));
    byId("frusta").replaceChildren(...this.frusta);
    const starts = !this.follow() && !matchMedia("(prefers-reduced-motion: reduce)").matches;
    this.play(starts);
    this.turning = starts && !this.deformation.moves;
    for (const id of ["timing", "beside", "part"]) byId(id).hidden = !this.deformation.moves;
    if (!this.deformation.moves) byId("channel").lastElementChild.remove();
    byId("full").hidden = !document.fullscreenEnabled;
    this.listen();
    this.listenToPointers(byId("stage"));
    this.resize();
    addEventListener("resize", () => this.resize());
    document.body.className = "ready";
    requestAnimationFrame((now) => this.tick(now));
  }

  setTime(time) {
    this.time = within(time, 0, 1);
    byId("time").value = this.time;
    byId("clock").textContent = this.time.toFixed(3);
  }

  play(whether) {
    this.playing = whether && this.deformation.moves;
    if (this.playing && this.time >= 1) this.setTime(0);
    byId("play").textContent = this.playing ? "pause" : "play";
  }

  /** Camera and time in a link; the pose is what camera paths of stage=render have. */
  get link() {
    const { right, up, backward, eye, distance, fov, middle } = this.camera;
    const offset = this.scene.offset; // of the capture's world, far from the origin
    const rows = [0, 1, 2].map((k) => [right[k], up[k], backward[k], eye[k] + offset[k]]);
    const digits = offset.some(Boolean) ? 15 : 7;
    const pose = rows.flat().map((value) => value.toPrecision(digits));
    const lens = `&fov=${(fov * 180) / Math.PI}&middle=${middle}`;
    return `#pose=${pose}&distance=${distance}${lens}&time=${this.time}`;
  }

  /** Takes what the page's link says, and tells whether it says anything. */
  follow() {
    const words = new URLSearchParams(location.hash.slice(1));
    const [distance, fov, time] = ["distance", "fov", "time"].map((k) => parseFloat(words.get(k)));
    const list = (name, otherwise) => (words.get(name) ?? otherwise).split(",").map(parseFloat);
    const [given, middle] = [list("pose", ""), list("middle", "0,0")];
    const { offset } = this.scene;
    const pose = given.map((value, k) => (k % 4 === 3 ? value - offset[(k - 3) / 4] : value));
    const numbers = [...pose, middle[0], middle[1], distance].every(Number.isFinite);
    const poses = pose.length === 12 && numbers && distance > 0 && fov > 0 && fov < 180;
    if (poses) this.look(Camera.of({ pose, distance, fov: (fov * Math.PI) / 180, middle }));
    if (time >= 0) this.setTime(time);
    return poses || time >= 0;
  }

  resize() {
    const ratio = Math.min(devicePixelRatio, 2);
    // A collapsed frame has no pixels, which graphics drivers refuse.
    const edges = [innerWidth, innerHeight].map((edge) => Math.max(Math.round(edge * ratio), 1));
    const [width, height] = edges;
    const { gl, canvas } = this.graphics;
    Object.assign(canvas, { width, height });
    gl.renderbufferStorage(gl.RENDERBUFFER, gl.RGBA8, width, height);
    this.state = null;
  }

  /** Pictures side by side: the rest state is on the left, if it is wanted. */
  get count() {
    return byId("rest").checked ? 2 : 1;
  }

  /** Of half the angle that is shown: from as much farther that each half shows the whole width. */
  get tangent() {
    return this.count * Math.tan(this.camera.fov / 2);
  }

  /** Uniforms of each part of the picture. */
  parts() {
    const { right, up, backward, eye, middle } = this.camera;
    const { width, height } = this.graphics.canvas;
    const { count, tangent } = this;
    const slope = [(tangent * width) / height / count, tangent];
    const [channel, part] = ["channel", "part"].map((id) => Number(byId(id).value));
    const view = { right, up, backward, eye, slope, middle, channel, part };
    const now = { ...view, ...this.deformation.uniforms(this.time) };
    return count > 1 ? [{ ...now, warps: false, distances: REST }, now] : [now];
  }

  /** The exact program if it is twice as fast as need be, or the preview; and its rows. */
  plan() {
    const { width, height } = this.graphics.canvas;
    const fast = this.graphics.program(0);
    const exact = this.graphics.programs[1];
    // Where the fast one takes no time, the exact one may be tried.
    const cost = exact?.warm ? exact.cost : 5 * fast.cost;
    if (fast.warm && 2 * cost * width * height <= BUDGET) return [this.graphics.program(1), height];
    const rows = Math.sqrt((BUDGET * height) / (fast.cost * width));
    return [fast, Math.round(within(rows, Math.min(MIN_ROWS, height), height))];
  }

  tick(now) {
    if (document.body.className === "failed") return;
    requestAnimationFrame((next) => this.tick(next));
    this.advance(Math.min((now - this.last) / 1000, 0.5));
    this.last = now;
    this.deformation.load(this.time);
    const { graphics } = this;
    if (!graphics.idle) return;
    const parts = this.parts();
    const state = JSON.stringify([parts, this.deformation.interval, byId("cameras").checked]);
    if (state !== this.state) {
      Object.assign(this, { state, changed: now });
      const { width, height } = graphics.canvas;
      const [program, rows] = this.plan();
      graphics.draw(program, parts, Math.ceil((width * rows) / height), rows, 0, rows);
      const quality = program === graphics.programs[1] ? 2 : Math.floor(rows / height);
      this.refined = quality * height;
      this.shown = [...this.shown.filter((when) => now - when < 1000), now];
      const seconds = (now - this.shown[0]) / 1000;
      this.report("moving", rows, seconds > 0 ? (this.shown.length - 1) / seconds : 0);
      this.drawFrusta();
    } else if (now - this.changed > SETTLED && !this.deformation.loading) {
      this.refine(parts);
    }
  }

  /** Draws the next rows of the whole picture, from above: a preview, then at full quality. */
  refine(parts) {
    const { width, height } = this.graphics.canvas;
    if (this.refined < 2 * height) {
      const program = this.graphics.program(this.refined < height ? 0 : 1);
      const left = height - (this.refined % height);
      const rows = within(Math.floor(BUDGET / (program.cost * width)), 1, left);
      this.graphics.draw(program, parts, width, height, left - rows, left);
      this.refined += rows;
      this.report(`refining ${Math.round((50 * this.refined) / height)} %`, height, 0);
    } else if (root.dataset.quality !== "full") {
      this.report("full", height, 0);
      if (this.saving) this.save();
    }
  }

  /** Tells people and programs what is shown, and how fast. */
  report(quality, rows, rate) {
    const framesPerSecond = rate.toFixed(1);
    Object.assign(root.dataset, { quality, rows, framesPerSecond });
    byId("status").textContent = `${rows} rows, ${rate ? `${framesPerSecond} frames/s` : quality}`;
  }

  /** Lets time run, and keys move. */
  advance(seconds) {
    if (this.playing) {
      const time = this.time + (seconds * Number(byId("speed").value)) / DURATION;
      if (time > 1 && !byId("loop").checked) this.play(false);
      this.setTime(time > 1 && this.playing ? time % 1 : time);
    }
    const angle = (2 * Math.PI * seconds) / TURN;
    if (this.turning) this.camera = this.camera.turned(angle, 0, this.scene.up);
    const held = (one, other) => 0.7 * seconds * (this.keys.has(one) - this.keys.has(other));
    const way = [held("KeyD", "KeyA"), held("KeyE", "KeyQ"), held("KeyS", "KeyW")];
    if (way.some(Boolean)) this.look(this.camera.moved(...way));
  }

  zoom(factor) {
    this.look(new Camera({ ...this.camera, distance: this.camera.distance * factor }));
  }

  /** Saves the picture, which is at full quality. */
  save() {
    this.saving = false;
    const download = `${this.scene.name}_t${this.time.toFixed(3)}.png`;
    const href = this.graphics.canvas.toDataURL();
    Object.assign(document.createElement("a"), { href, download }).click();
  }

  /** Draws the captured cameras as frusta, if they are wanted: into the picture on the right. */
  drawFrusta() {
    const { right, up, backward, eye, middle } = this.camera;
    const wanted = byId("cameras").checked;
    const scale = innerHeight / 2 / this.tangent;
    const left = innerWidth * (1 - 1 / this.count);
    byId("frusta").style.clipPath = `inset(0 0 0 ${left}px)`;
    const place = (point) => {
      const away = along(point, -1, eye);
      const ahead = Math.max(-dot(away, backward), 1e-6);
      const [x, y] = [right, up].map((axis, k) => scale * (dot(away, axis) / ahead - middle[k]));
      return [(left + innerWidth) / 2 + x, innerHeight / 2 - y];
    };
    const distance = this.scene.frustum;
    this.scene.cameras.forEach((captured, k) => {
      const [image, lines] = this.frusta[k].children;
      const camera = Camera.of({ ...captured, distance });
      const tall = Math.tan(captured.fov / 2);
      const [wide, [aside, low]] = [tall * captured.aspect, captured.middle];
      const corner = (x, y) => place(camera.moved(aside + x * wide, low + y * tall, 0).target);
      const behind = dot(along(camera.eye, -1, eye), backward) > -2 * distance;
      this.frusta[k].toggleAttribute("hidden", !wanted || behind);
      const [a, b, c, d] = [corner(-1, 1), corner(1, 1), corner(1, -1), corner(-1, -1)];
      const tip = place(camera.eye);
      lines.setAttribute("points", [tip, a, b, tip, c, d, tip, a, d, c, b].join(" "));
      if (!wanted || location.search !== "?pictures") return;
      // Served with pictures: what the camera saw at the nearest time.
      const gaps = captured.times.map((time) => Math.abs(time - this.time));
      const source = `pictures/${captured.name}/${gaps.indexOf(Math.min(...gaps))}.jpg`;
      if (image.getAttribute("href") !== source) image.setAttribute("href", source);
      const edges = [...along(b, -1, a), ...along(d, -1, a)];
      image.setAttribute("transform", `matrix(${[...edges, ...a]})`);
    });
  }

  /** Makes what a place on the page shows the target. */
  center(x, y) {
    const { canvas } = this.graphics;
    const ratio = canvas.height / innerHeight;
    const width = innerWidth / this.count;
    const [part, left] = [this.parts()[Math.floor(x / width)], x % width];
    const corner = [-left * ratio, y * ratio + 1 - canvas.height];
    const away = this.graphics.reach(part, [...corner, width * ratio, canvas.height]);
    this.state = null; // a pixel was drawn over
    if (away === 0) return;
    const { right, up, backward, eye, slope, middle } = part;
    const screen = [(2 * left) / width - 1, 1 - (2 * y) / innerHeight];
    const [wide, high] = along(middle, 1, [0, 1].map((k) => slope[k] * screen[k]));
    const across = along(scaled(right, wide), high, up);
    const ahead = unit(along(across, -1, backward));
    const distance = -away * dot(ahead, backward);
    this.look(new Camera({ ...this.camera, target: along(eye, away, ahead), distance }));
  }

  /** Takes another camera, from somebody who wants it. */
  look(camera) {
    Object.assign(this, { camera, turning: false });
  }

  listen() {
    const acts = {
      play: () => this.play(!this.playing),
      home: () => this.look(Camera.of(this.scene.cameras[0])),
      full: () => document.exitFullscreen().catch(() => root.requestFullscreen()),
      save: () => {
        this.play(false);
        Object.assign(this, { turning: false, saving: true });
        root.dataset.quality = "saving";
      },
      link: async () => {
        history.replaceState(null, "", this.link);
        const copying = navigator.clipboard?.writeText(location.href);
        const copied = await copying?.then(() => "copied, and in", () => null);
        byId("status").textContent = `the link is ${copied ?? "in"} the address`;
      },
    };
    for (const [id, act] of Object.entries(acts)) byId(id).addEventListener("click", act);
    byId("time").addEventListener("input", (event) => {
      this.play(false);
      this.setTime(Number(event.target.value));
    });
    const keys = { Space: "play", KeyR: "rest", KeyC: "cameras", KeyH: "home", KeyF: "full" };
    addEventListener("keydown", (event) => {
      // A control that has the focus takes keys for itself.
      const control = event.code === "Space" ? "button, input, select" : "select";
      if (event.ctrlKey || event.metaKey || event.altKey || event.repeat) return;
      if (event.target.matches(control)) return;
      const named = byId(keys[event.code]);
      if (named && !named.closest("[hidden]")) named.click();
      this.keys.add(event.code);
    });
    addEventListener("keyup", (event) => this.keys.delete(event.code));
    addEventListener("blur", () => this.keys.clear());
    addEventListener("hashchange", () => this.follow() && this.play(false));
  }

  listenToPointers(stage) {
    const fingers = new Map();
    let travelled = 0;
    stage.addEventListener("pointerdown", (event) => {
      if (fingers.size === 0) travelled = 0;
      fingers.set(event.pointerId, event);
    });
    addEventListener("pointermove", (event) => {
      const before = fingers.get(event.pointerId);
      if (!before) return;
      const x = (event.clientX - before.clientX) / innerHeight;
      const y = (event.clientY - before.clientY) / innerHeight;
      travelled += Math.hypot(x, y) * innerHeight;
      fingers.set(event.pointerId, event);
      const { camera } = this;
      const height = 2 * this.tangent;
      const other = [...fingers.values()].find(({ pointerId }) => pointerId !== event.pointerId);
      if (other) {
        const apart = (one) => Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY);
        this.look(camera.moved((-x * height) / 2, (y * height) / 2, 0));
        this.zoom(apart(before) / Math.max(apart(event), 1));
      } else if (event.buttons & 6 || event.shiftKey) {
        this.look(camera.moved(-x * height, y * height, 0));
      } else this.look(camera.turned(-2 * Math.PI * x, Math.PI * y, this.scene.up));
    });
    addEventListener("pointerup", (event) => fingers.delete(event.pointerId));
    addEventListener("pointercancel", (event) => fingers.delete(event.pointerId));
    stage.addEventListener("click", (event) => {
      const frustum = this.frusta.indexOf(event.target.closest("g"));
      if (frustum >= 0 && travelled < 8) this.look(Camera.of(this.scene.cameras[frustum]));
    });
    stage.addEventListener("dblclick", (event) => this.center(event.clientX, event.clientY));
    stage.addEventListener("contextmenu", (event) => event.preventDefault());
    // Pinching a trackpad turns the wheel, and would enlarge the whole page, too.
    const zoom = (event) => {
      if (!stage.contains(event.target)) return;
      event.preventDefault();
      const pixels = event.deltaY * (event.deltaMode ? 30 : 1);
      this.zoom(Math.exp(within(pixels, -300, 300) / 800));
    };
    addEventListener("wheel", zoom, { passive: false });
  }
}

addEventListener("unhandledrejection", (event) => fail(event.reason));
addEventListener("error", (event) => fail(event.error ?? event));
if (!byId("end")) throw new Error(`${DAMAGED}.`);
const scene = JSON.parse(byId("description").textContent);
byId("message").textContent = "The scene is being unpacked …";
const graphics = new Graphics(byId("picture"), scene);
await graphics.load();
new Page(scene, graphics);
