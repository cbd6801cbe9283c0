"""Beyond the paper: each file plugs in, and can be taken out with its block of schedule.extensions."""
