"""``python -m service.cli``: the `octobake` command, for whoever has this interpreter but not its scripts on the path."""

import sys

from service.cli import main

if __name__ == "__main__":
    sys.exit(main())
