"""Beyond the paper: a file plugs in, and goes out with its block of schedule.extensions."""
