"""The `octobake` command: one file per command, all errors printed in one place."""

from __future__ import annotations

import argparse
import importlib
import json
import sys
from collections.abc import Sequence

from bake_core.errors import OctobakeError

# In the order of --help. Imported only when used, so that `octobake status` does not wait for numba.
COMMANDS = ("bake", "plan", "info", "sample", "verify", "serve", "submit", "wait", "status", "list", "cancel", "fetch")
