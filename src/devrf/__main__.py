"""``python -m devrf``."""

from devrf.cli.main import entry

if __name__ == "__main__":
    entry()
