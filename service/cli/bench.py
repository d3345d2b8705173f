"""``octobake bench``: measurements that people repeat, each with a table, JSON, CSV and a plot."""

from __future__ import annotations

import argparse
import json
import os
import shlex
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from service.cli.bake import positive

if TYPE_CHECKING:
    from bake_core.bench.outcome import Outcome
    from bake_core.bench.targets import Subject

_SCENES = "scenes; the built-in Cornell box where none is named"


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser("bench", help="measure error against run time, beside other renderers; what adapting and leaving out save")
    kinds = parser.add_subparsers(dest="kind", metavar="KIND", required=True)

    written = argparse.ArgumentParser(add_help=False)
    written.add_argument("-o", "--out", metavar="DIR", type=Path, required=True, help="KIND.json, .csv, .md, .svg and .png go here")
    written.add_argument("--markdown", metavar="FILE", type=Path, help="also put the table into this page, between its two marks")
    written.add_argument("--json", action="store_true", help="print what was measured as one JSON document")
    threaded = argparse.ArgumentParser(add_help=False, parents=[written])
    threaded.add_argument("--threads", type=positive, default=os.cpu_count() or 1, help="default: all cores")
    shared = argparse.ArgumentParser(add_help=False, parents=[threaded])
    shared.add_argument("--spec", metavar="SPEC", type=Path, help="a JSON file, or a folder with NAME.json for each scene NAME")

    race = kinds.add_parser(
        "convergence", parents=[shared], help="error against run time of ours and of Mitsuba and Cycles where installed"
    )
    race.add_argument("scenes", metavar="SCENE", nargs="*", type=Path, help="one scene; the built-in Cornell box where none is named")
    race.add_argument("--samples", metavar="N,N,…", type=_numbers(int, 1), default=[16, 64, 256], help="default: 16,64,256")
    race.add_argument("--runs", type=positive, default=3, help="of each; the median counts; default: 3")
    race.add_argument("--peers", metavar="DIR", type=Path, help="environments mitsuba/ and cycles/; default: what this Python can import")
    race.add_argument("--reference", metavar="FILE", type=Path, help="an .npz that is read, or written where there is none")
    race.add_argument("--reference-samples", metavar="N", type=positive, default=4096, help="of either half of our own; default: 4096")

    errors = kinds.add_parser("targets", parents=[shared], help="seconds, samples, stated and audited error of bakes to target errors")
    errors.add_argument("scenes", metavar="SCENE", nargs="*", type=Path, help=_SCENES)
    errors.add_argument("--targets", metavar="E,E,…", type=_numbers(float, 0), default=[0.05, 0.02, 0.01], help="default: 0.05,0.02,0.01")
    few = "what each audit may take, beside the bake's seconds; 3 % of a bake of a second would resolve nothing; default: 10"
    errors.add_argument("--audit-seconds", metavar="S", type=_number(float, 0), default=10.0, help=few)

    pairs = (
        kinds.add_parser("adaptive", parents=[shared], help="adaptive sampling against uniform, at equal error"),
        kinds.add_parser("leaving-out", parents=[shared], help="leaving out what a scene does not need against all five outputs"),
        kinds.add_parser("integrators", parents=[shared], help="the light cache, where auto takes it, against paths traced to their ends"),
    )
    for pair in pairs:
        pair.add_argument("scenes", metavar="SCENE", nargs="*", type=Path, help=_SCENES)
        pair.add_argument("--target", metavar="E", type=_number(float, 0), default=0.02, help="error that both bake to; default: 0.02")
        pair.add_argument("--runs", type=positive, default=3, help="of each, in turns; default: 3")
    speed = kinds.add_parser("throughput", parents=[shared], help="paths and rays a second, and how much of the time is Embree's")
    speed.add_argument("scenes", metavar="SCENE", nargs="*", type=Path, help=_SCENES)
    speed.add_argument("--runs", type=positive, default=5, help="of each, in turns; the median counts; default: 5")

    growth = kinds.add_parser("scale", parents=[threaded], help="what tracing costs as threads, probes, triangles and emitters grow")
    growth.add_argument("--runs", type=positive, default=3, help="of each, in turns; the median counts; default: 3")
    cores = os.cpu_count() or 1
    grown = (
        ("threads", sorted({1, cores}), "1 and all cores"),
        ("probes", [64, 512, 4096], "64,512,4096"),
        ("triangles", [1000, 10_000, 100_000, 1_000_000], "10³ to 10⁶"),
        ("emitters", [2, 100, 10_000, 100_000], "2 to 10⁵"),
    )
    for axis, sizes, words in grown:
        growth.add_argument(f"--{axis}-sizes", metavar="N,N,…", type=_numbers(int, 1), default=sizes, help=f"default: {words}")

    service = kinds.add_parser("service", parents=[written], help="what the service adds to a bake, and how soon it answers")
    service.add_argument("--runs", type=positive, default=3, help="of the bake each way, in turns; the median counts; default: 3")
    service.add_argument("--bake-seconds", metavar="S", type=_number(float, 0), default=60.0, help="of the bake, about; default: 60")

    for limited in (errors, *pairs):
        limited.add_argument("--max-seconds", metavar="S", type=_number(float, 0), default=600.0, help="of any one bake; default: 600")
        limited.add_argument("--max-samples", metavar="N", type=positive, default=65536, help="of any one bake; default: 65536")
    parser.set_defaults(run=run)


def _number(kind: type, above: float) -> Callable[[str], float]:
    def read(text: str) -> float:
        try:
            value: float = kind(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r} is no number") from None
        if not (above < value < float("inf") or (kind is int and value == above)):
            raise argparse.ArgumentTypeError(f"{text} must be {'at least' if kind is int else 'above'} {above}")
        return value

    return read


def _numbers(kind: type, above: float) -> Callable[[str], list[float]]:
    return lambda text: sorted({_number(kind, above)(part) for part in text.split(",")})


def run(args: argparse.Namespace) -> int:
    """Measure, write, print."""
    from bake_core.bench import outcome
    from bake_core.errors import InputError

    if args.out.exists() and not args.out.is_dir():
        raise InputError("bench.no_folder", "is no folder; name one that exists or can be made", str(args.out))
    began = time.perf_counter()

    def say(line: str) -> None:
        print(f"[{time.perf_counter() - began:6.1f} s] {line}", file=sys.stderr, flush=True)

    found = _measure(args, say)
    command = shlex.join(["octobake", *(args.argv if hasattr(args, "argv") else sys.argv[1:])])
    outcome.write(found, args.kind, command, args.out, args.markdown)
    if args.json:
        print(json.dumps({"bench": args.kind, **found.document()}, indent=2))
    else:
        print(outcome.as_text(found.table()))
        print("\n".join(["", *found.notes()]))
        print(f"{args.out / args.kind}.json, .csv, .md, .svg, .png")
    return 0


def _measure(args: argparse.Namespace, say: Callable[[str], None]) -> Outcome:
    if args.kind == "service":
        from service.cli import bench_service

        return bench_service.measure(args.bake_seconds, args.runs, say)
    if args.kind == "scale":
        from bake_core.bench import scale

        sizes = {axis: getattr(args, f"{axis}_sizes") for axis in scale.AXES}
        return scale.measure(sizes, threads=args.threads, runs=args.runs, say=say)
    with tempfile.TemporaryDirectory(prefix="octobake-bench-") as folder:
        return _measure_scenes(args, _subjects(args, Path(folder)), say)


def _measure_scenes(args: argparse.Namespace, subjects: list[Subject], say: Callable[[str], None]) -> Outcome:
    from bake_core.bench import convergence, pairs, targets, throughput
    from bake_core.environment import beside
    from bake_core.errors import InputError
    from bake_core.spec import Stop

    if args.kind == "convergence":
        if len(subjects) > 1:
            raise InputError("bench.one_scene", "races are run one scene at a time; name one", str(args.scenes[1]))
        (one,) = subjects
        return convergence.measure(
            one.scene,
            one.spec,
            find=beside(one.images),
            threads=args.threads,
            samples=args.samples,
            runs=args.runs,
            reference_samples=args.reference_samples,
            reference=args.reference,
            peers=args.peers,
            say=say,
        )
    if args.kind == "throughput":
        return throughput.measure(subjects, threads=args.threads, runs=args.runs, say=say)
    if args.kind == "targets":
        return targets.measure(
            subjects,
            args.targets,
            threads=args.threads,
            max_seconds=args.max_seconds,
            max_samples=args.max_samples,
            audit_seconds=args.audit_seconds,
            say=say,
        )
    stop = Stop(target_error=args.target, max_seconds=args.max_seconds, max_samples=args.max_samples)
    return pairs.measure(args.kind, subjects, threads=args.threads, stop=stop, runs=args.runs, say=say)


def _subjects(args: argparse.Namespace, folder: Path) -> list[Subject]:
    """Scenes with their specs; the built-in one is written into a folder first."""
    from bake_core.bench.targets import Subject
    from bake_core.errors import InputError
    from bake_core.examples import cornell
    from bake_core.spec import load_spec, parse_spec

    if not args.scenes:
        glb, spec = cornell()
        (folder / "cornell.glb").write_bytes(glb)
        if args.spec is not None:
            return [Subject("cornell", folder / "cornell.glb", load_spec(args.spec), args.spec.parent)]
        # Four scatter vertices: what the published peers' figures were measured with, and what every renderer means the same by.
        bounces = {"max_bounces": 4} if args.kind == "convergence" else {}
        return [Subject("cornell", folder / "cornell.glb", parse_spec({**spec, **bounces}), folder)]
    if args.spec is None:
        raise InputError("bench.no_spec", "a scene needs a spec; name a file, or a folder with one for each scene", "--spec")
    out = []
    for scene in args.scenes:
        path = args.spec / f"{scene.stem}.json" if args.spec.is_dir() else args.spec
        out.append(Subject(scene.stem, scene, load_spec(path), path.parent))
    return out
