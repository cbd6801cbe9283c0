"""Raw footage becomes a scene: ``stage=capture``, one step a module.

    footage     a video, or a folder of photographs, frame by frame with times in seconds
       │
    survey      the sharpness of each frame, and the motion from one frame to the next
       ├──────────────► picking     the sharpest frame of each stretch of the static video
       └──────────────► alignment   offsets of the fixed videos' clocks; the times, and
       │                            each video's frame that is nearest to each time
    frames      these frames as image files of one size
       │
    structure   structure from motion over the picked frames and the first frame of each fixed
       │        video (the scene is at rest in all of them): cameras, lenses, sparse points;
       │        of one moving camera again, without the pixels that ``movers`` masks
    normalisation   origin, axes and unit; from which side the cameras look; near, far and box
       │
    writing     ``transforms.json`` with a ``time`` on each frame, and the lists of held-out images

``footage`` and ``normalisation`` are in :mod:`devrf.scenes`, whose readers use them, too;
``picking`` is in ``survey``, ``frames`` in ``images``, and ``writing`` in ``pipeline``.

Each step keeps its result in ``<into>/capture``, with a hash of its inputs: the same
command again continues after the last step whose inputs are unchanged. ``transforms.json`` is
written last: a folder that has it is complete.

World: OpenGL axes. Cameras that face the scene from one side get the world of their average pose
(x right, y up, −z ahead), in which the nearest point is at 1/0.75; cameras around the scene get one
in which z points up, the point that they look at is the origin, and their median distance is 4.
"""
