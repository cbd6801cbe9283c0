"""The configuration; a package, so that Hydra finds ``pkg://devrf.conf``."""
