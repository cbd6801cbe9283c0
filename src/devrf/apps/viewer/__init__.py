"""A learned scene in a browser: orbit, fly, run time, collect keyframes of a video."""
