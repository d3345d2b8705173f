"""Coverage-guided fuzzing of the scene reader: ``make fuzz`` mutates the corpus, and lets nothing but our refusals out.

The first byte of an input chooses what kind of file the rest is. A finding is written to `--findings`, and libFuzzer ends with its stack.
"""

from __future__ import annotations

import argparse
import os
import struct
import sys
import tempfile
from contextlib import suppress
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["bake_core"]):
    from bake_core.errors import InputError
    from service import reading

from tests.faults.corpus import corpus
from tests.faults.fault import changed

NAMES = ("scene.glb", "scene.gltf", "scene.zip", "scene.obj", "scene.ply", "scene.stl")
# A child of the service's is limited; in here a mutated count that asks for gigabytes would end the fuzzer instead.
LARGEST_INPUT, MEMORY_MB, SLOWEST_SECONDS = 1 << 16, 4096, 60


def seeds(folder: Path) -> int:
    """Write a sound scene and every fault that is one file; answers how many there are."""
    # The first is accepted, for what lies behind the refusals.
    inputs = [(0, changed())]
    for fault in corpus():
        suffix = Path(fault.root).suffix.lower()
        kind = next((i for i, name in enumerate(NAMES) if name.endswith(suffix)), None) if suffix else None
        if kind is not None and fault.root in fault.files and len(fault.files[fault.root]) < LARGEST_INPUT:
            inputs.append((kind, fault.files[fault.root]))
    for number, (kind, data) in enumerate(inputs):
        (folder / f"{number:04}").write_bytes(struct.pack("B", kind) + data)
    return len(inputs)


def read(data: bytes, folder: Path) -> None:
    """Read one input as the service's child does; what is no InputError comes out."""
    if not data:
        return
    name = NAMES[data[0] % len(NAMES)]
    path = folder / name
    path.write_bytes(data[1:])
    with suppress(InputError):
        reading.read_outline(name, {name: path})


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--findings", type=Path, default=Path("out/fuzz"), metavar="FOLDER")
    parser.add_argument("inputs", nargs="*", type=Path, help="only read these again, as found")
    args = parser.parse_args()
    # Below the memory file system where there is one: an input is written for each execution.
    with tempfile.TemporaryDirectory(prefix="octobake-fuzz-", dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as name:
        folder = Path(name)
        if args.inputs:
            for path in args.inputs:
                read(path.read_bytes(), folder)
            return
        given = folder / "corpus"
        given.mkdir()
        print(f"{seeds(given)} seeds", flush=True)
        args.findings.mkdir(parents=True, exist_ok=True)
        options = {
            "max_total_time": args.seconds,
            "seed": args.seed,
            "max_len": LARGEST_INPUT,
            "rss_limit_mb": MEMORY_MB,
            "timeout": SLOWEST_SECONDS,
            "print_final_stats": 1,
            "artifact_prefix": f"{args.findings}/",
        }
        # libFuzzer ends its process at once, and would leave the folder behind.
        child = os.fork()
        if not child:
            atheris.Setup(
                [sys.argv[0], *(f"-{key}={value}" for key, value in options.items()), str(given)], lambda data: read(data, folder)
            )
            atheris.Fuzz()
        _, status = os.waitpid(child, 0)
    raise SystemExit(os.waitstatus_to_exitcode(status))


if __name__ == "__main__":
    main()
