"""From what was gathered to the files of a bundle: normalise, pack, choose encodings, write, and say all of it in the manifest."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from bake_core import __version__
from bake_core.allocation import SCRAMBLES
from bake_core.atlas import Layout, choose_encoding, layout, pack
from bake_core.bundle import CHANNELS, FORMAT, SHADERS, VERSION, Atlas, VolumeData, digest_file
from bake_core.convergence import Verdict
from bake_core.embree import instruction_set
from bake_core.errors import BakeError
from bake_core.gloss_levels import gloss_alphas
from bake_core.images import write_exr
from bake_core.parameters import PARAMETERS, Choice, default_choices
from bake_core.placement import Volume
from bake_core.relocation_trial import Trial
from bake_core.selection import LeftOut, Selection
from bake_core.shader_constants import bundle_constants, probe_texels
from bake_core.shader_files import shader_dir
from bake_core.spec import OutputName, Spec
from bake_core.tally import State
from bake_core.volume_chains import CHAINS, chain_levels, chain_size, traceable, volume_chain
from bake_core.walls import coarser

F32 = NDArray[np.float32]

# Visibility is always stored in full: the variance is a small difference of its two moments, and half floats lose it (DESIGN: half of all
# flat-wall variances come out negative). Distances are metres of any scale.
_ALWAYS_FULL = ("visibility", "distance")

_BYTES = {"half": 2, "float": 4}
# As many as anybody would go and look at.
_WORST_PROBES = 8


class Subject(Protocol):
    """What the manifest says of what was baked; a Scene is one."""

    @property
    def digest(self) -> str: ...
    @property
    def triangle_count(self) -> int: ...
    @property
    def ignored(self) -> tuple[str, ...]: ...


def assemble(
    scene: Subject,
    spec: Spec,
    volumes: tuple[Volume, ...],
    offsets: F32,
    trials: Sequence[Trial | None],
    selection: Selection,
    left_out: tuple[LeftOut, ...],
    state: State,
    stopped: Verdict,
    cached: float | None,
    folder: Path,
    choose: Callable[[Sequence[Sequence[VolumeData]]], list[Choice]] = default_choices,
) -> dict[str, Any]:
    """Write atlases and shaders into a folder.

    Parameters
    ----------
    offsets : (n, 3) float32
        Of all volumes' probes in turn from their lattice points, metres.
    trials : sequence of Trial or None
        What was measured of each volume to decide on them.
    left_out : tuple of LeftOut
        Outputs and all else.
    cached : float or None
        The share of what probes see that was in the light cache at first; None where every path was traced to its end.
    choose : callable
        What each volume's query uses, by the volumes as they may be read: each once for each resolution of its visibility.

    Returns
    -------
    dict
        The manifest; a function of scene, spec and version only, except where a time limit ended the bake.

    Raises
    ------
    BakeError
        ``bake.not_finite`` where a value is not finite or negative: nothing of the kind is ever written.
    """
    whole = spec.outputs != "auto"
    packed, first = [], 0
    for index, volume in enumerate(volumes):
        probes = slice(first, first + volume.probe_count)
        packed.append(_pack(volume, offsets[probes], selection.of(index), selection, state, probes, whole=whole))
        first += volume.probe_count
    entries, data, saved = [], [], np.zeros(2, np.int64)
    choices = choose([[p.content for p in ways] for ways in packed])
    for ways, choice, trial in zip(packed, choices, trials, strict=True):
        content, described = ways[choice.resolution]
        content = replace(content, parameters=choice.parameters)
        entries.append(_write(content, described, choice, trial, folder))
        data.append(content)
        size = sum(a.tile**2 * len(CHANNELS[a.output]) * _BYTES[a.encoding] for a in content.atlases.values())
        saved += np.array([(content.states == left_out_as).sum() * size for left_out_as in (0, 2)])
    shaders = folder / "shaders"
    shaders.mkdir()
    for name in (*SHADERS, "README.md"):
        shutil.copyfile(shader_dir() / name, shaders / name)
    (shaders / "constants.glsl").write_text(bundle_constants(data))
    names = sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())
    return {
        "format": FORMAT,
        "version": VERSION,
        "generator": f"octobake {__version__}",
        "instruction_set": instruction_set(),
        "scene": {"digest": scene.digest, "triangles": scene.triangle_count, "ignored": list(scene.ignored)},
        "spec": spec.canonical(),
        "samples": state.samples,
        "stopped": stopped,
        "sampling": {"mean_samples": state.mean_samples(), "uniform_samples": state.uniform_samples(), "cached": cached},
        "error": _error(spec, volumes, selection, state),
        "left_out": [x.entry() for x in left_out] + _left_out_probes(state, saved) + _left_out_channels(entries, data),
        "volumes": entries,
        "shaders": [f"shaders/{name}" for name in (*SHADERS, "constants.glsl")],
        "files": {name: {"sha256": digest_file(folder / name), "bytes": (folder / name).stat().st_size} for name in names},
    }


def _left_out_probes(state: State, saved: NDArray[np.int64]) -> list[dict[str, Any]]:
    """What the manifest says of probes that are neither traced nor stored; `saved` bytes before compression, by the two reasons."""
    count = [int((state.needed & ~state.active()).sum()), int((~state.needed).sum())]
    why = [
        "inside solids: more than a quarter of what they see are backs of single-sided surfaces",
        "needed by no surface: none lies in the cells around them, and the spec's receivers are surfaces",
    ]
    whole = len(state.needed)
    return [{"what": f"{n} of {whole} probes", "why": w, "bytes": int(b)} for n, w, b in zip(count, why, saved, strict=True) if n]


def _left_out_channels(entries: list[dict[str, Any]], data: list[VolumeData]) -> list[dict[str, Any]]:
    """What the manifest says of maps that take less room than their texels."""
    out = []
    for entry, volume in zip(entries, data, strict=True):
        for described in entry["atlases"]:
            atlas, names = volume.atlases[described["output"]], described["channels"]
            size = atlas.texels[..., 0].size * _BYTES[atlas.encoding]
            what = f"{volume.name}: {atlas.output}"
            if "constant" in described:
                out.append({"what": f"{what} map", "why": "every texel is the same", "bytes": size * len(names)})
            elif len(set(names)) < len(names):
                why = "nothing in it has a hue: one channel holds all three"
                out.append({"what": f"{what} in colour", "why": why, "bytes": size * (len(names) - 1)})
    return out


def _error(spec: Spec, volumes: tuple[Volume, ...], selection: Selection, state: State) -> dict[str, Any]:
    """DESIGN's figure, the same of each output that is sampled, and who errs most."""
    probes = state.probe_errors()
    measured = np.flatnonzero(np.isfinite(probes))
    # Where two err alike the first comes first, on every machine.
    worst = measured[np.argsort(-probes[measured], kind="stable")[:_WORST_PROBES]]
    first = np.cumsum([0] + [v.probe_count for v in volumes])
    rows = []
    for flat in worst:
        of = int(np.searchsorted(first, flat, "right")) - 1
        probe = int(flat - first[of])
        position = volumes[of].positions()[probe].tolist()
        rows.append({"volume": volumes[of].name, "probe": probe, "position": position, "error": float(probes[flat])})
    known = {"irradiance": state.error(), "radiance": state.radiance_error()}
    return {
        "value": state.error(),
        "target": spec.stop.target_error,
        "scrambles": SCRAMBLES,
        # Visibility, distance and normal come from one ray through each texel's centre: nothing is drawn at random.
        "outputs": [{"output": output, "value": known.get(output)} for output in selection.outputs],
        "probes": {
            "median": float(np.median(probes[measured])) if len(measured) else None,
            "p95": float(np.percentile(probes[measured], 95)) if len(measured) else None,
            "worst": rows,
        },
    }


class _Packed(NamedTuple):
    """A volume as it will be read, with default parameters; and of each atlas what the manifest says."""

    content: VolumeData
    described: list[dict[str, Any]]


def _pack(
    volume: Volume,
    offsets: F32,
    outputs: tuple[OutputName, ...],
    selection: Selection,
    state: State,
    probes: slice,
    *,
    whole: bool,
) -> list[_Packed]:
    """Choose encodings and lay out atlases, once for each resolution of visibility; `whole` maps have a file and all channels."""
    active = state.active()[probes]
    kept = np.flatnonzero(active)
    maps: dict[str, F32] = {output: _interior(output, selection, state, probes)[kept] for output in outputs}
    seen = maps.get("visibility")
    if seen is not None:
        maps["visibility"], maps["walls"] = seen[..., :2], seen[..., 2:]
    shape = layout(volume.counts, max(m.shape[1] + 2 for m in maps.values()), len(kept))
    laid = {output: _lay(volume.name, output, interior, shape, kept, selection, whole) for output, interior in maps.items()}
    content = VolumeData(
        name=volume.name,
        origin=volume.origin,
        spacing=volume.spacing,
        counts=np.asarray(volume.counts, np.int64),
        states=np.where(active, 1, np.where(state.needed[probes], 0, 2)).astype(np.uint8),
        offsets=offsets,
        backface=state.backface[probes],
        parameters=PARAMETERS,
        distance_limit=volume.distance_limit,
        atlases={},
    )
    packed = [_packed(content, laid)]
    if seen is None:
        return packed
    for side in selection.coarser:
        fewer = coarser(seen, side)
        for output, interior in (("visibility", fewer[..., :2]), ("walls", fewer[..., 2:])):
            laid = laid | {output: _lay(volume.name, output, interior, shape, kept, selection, whole)}
        packed.append(_packed(content, laid))
    return packed


def _packed(content: VolumeData, laid: dict[str, tuple[Atlas, dict[str, Any]]]) -> _Packed:
    return _Packed(replace(content, atlases={o: atlas for o, (atlas, _) in laid.items()}), [entry for _, entry in laid.values()])


def _lay(
    volume: str, output: str, interior: F32, shape: Layout, kept: NDArray[np.int64], selection: Selection, whole: bool
) -> tuple[Atlas, dict[str, Any]]:
    """One output's atlas, and what the manifest says of it."""
    if not np.isfinite(interior).all() or (output != "normal" and (interior < 0).any()):
        bad = int(kept[np.argwhere(~np.isfinite(interior) | (interior < 0))[0][0]])
        raise BakeError("bake.not_finite", f"the {output} map has a value that is not finite or is negative", f"{volume}: probe {bad}")
    encoding, cost = ("float", 0.0) if output in _ALWAYS_FULL else choose_encoding(interior)
    side = interior.shape[1]
    atlas = Atlas(output, pack(interior, shape), side + 2, side, shape.columns, shape.rows, shape.layers, encoding)
    entry: dict[str, Any] = {
        "output": output,
        "file": f"{volume}.{output}.exr",
        "encoding": encoding,
        "encoding_error": cost,
        "channels": list(CHANNELS[output]),
        "tile": atlas.tile,
        "interior": atlas.interior,
    }
    if not whole and len(kept) and (interior == interior[0, 0, 0]).all():
        stored = interior[0, 0, 0].astype(np.float16 if encoding == "half" else np.float32)
        entry |= {"file": None, "constant": [float(str(x)) for x in stored]}
    elif not whole and entry["channels"] == ["R", "G", "B"] and (interior == interior[..., :1]).all():
        entry["channels"] = ["Y"] * 3
    if output == "distance":
        entry["miss"] = selection.miss_distance
        atlas = replace(atlas, miss=selection.miss_distance)
    return atlas, entry


def _write(volume: VolumeData, described: list[dict[str, Any]], choice: Choice, trial: Trial | None, folder: Path) -> dict[str, Any]:
    """A volume's files, and its entry in the manifest."""
    for entry in described:
        if entry["file"] is not None:
            texels = volume.atlases[entry["output"]].texels
            _write_layers(folder / entry["file"], texels, tuple(dict.fromkeys(entry["channels"])), half=entry["encoding"] == "half")
    probe_file = f"{volume.name}.probes.exr"
    _write_layers(folder / probe_file, probe_texels(volume), CHANNELS["probes"], half=False)
    shape = next(iter(volume.atlases.values()))
    return {
        "name": volume.name,
        "origin": volume.origin.tolist(),
        "spacing": volume.spacing.tolist(),
        "counts": volume.counts.tolist(),
        "distance_limit": volume.distance_limit,
        "parameters": dict(volume.parameters),
        "chosen": choice.entry(),
        "layout": {"columns": shape.columns, "rows": shape.rows, "layers": shape.layers},
        "probes": {
            "file": probe_file,
            "count": len(volume.states),
            "active": int((volume.states == 1).sum()),
            "states": volume.states.tolist(),
            "offsets": [[float(str(x)) for x in offset] for offset in volume.offsets] if volume.offsets.any() else None,
            "tried": trial and {"points": trial.points, "error": trial.error, "lattice_error": trial.lattice_error},
            # Shortest decimals of the float32 values.
            "backface": [float(str(b)) for b in volume.backface],
        },
        "atlases": described,
        "chains": [_chain(volume, chain, folder) for chain in CHAINS] if traceable([volume]) else [],
    }


def _chain(volume: VolumeData, chain: str, folder: Path) -> dict[str, Any]:
    """Write a chain; its entry in the manifest."""
    file = f"{volume.name}.{chain}.exr"
    half = chain == "gloss" and volume.atlases["radiance"].encoding == "half"
    _write_layers(folder / file, volume_chain(volume, chain), ("R", "G", "B") if chain == "gloss" else (chain,), half=half)
    levels: list[dict[str, Any]] = [{"x": x, "y": y, "side": side} for x, y, side in chain_levels(volume, chain)]
    if chain == "gloss":
        alphas = gloss_alphas(volume.atlases["radiance"].interior)
        levels = [{**level, "alpha": alpha} for level, alpha in zip(levels, alphas, strict=True)]
    width, height = chain_size(volume, chain)
    return {"chain": chain, "file": file, "encoding": "half" if half else "float", "width": width, "height": height, "levels": levels}


def _interior(output: OutputName, selection: Selection, state: State, probes: slice) -> F32:
    """One output's maps without borders, (p, side, side, channels) float32."""
    if output == "visibility":
        return state.visibility[probes]
    if output == "distance":
        return state.distance[probes].reshape(-1, selection.distance, selection.distance, 1)
    if output == "normal":
        return state.normal[probes].reshape(-1, selection.normal, selection.normal, 3)
    # Never a silent inf: what does not fit float32 is caught where maps are checked.
    with np.errstate(over="ignore"):
        if output == "irradiance":
            # The control variate is unbiased, so where a texel is all but black, noise can take it below zero: by less than its standard
            # error.
            mean = np.maximum(state.mean(probes), 0)
            return np.asarray(mean, np.float32).reshape(-1, selection.irradiance, selection.irradiance, 3)
        # So can a scramble's version of a cell in the light cache, where few scrambles have had a sample.
        mean = np.maximum(state.mean_radiance(probes), 0)
        return np.asarray(mean, np.float32).reshape(-1, selection.capture, selection.capture, 3)


def _write_layers(path: Path, texels: F32, channels: tuple[str, ...], *, half: bool) -> None:
    """Layers stacked downwards in one image, so that one read gives a 2D array's texels in order; of alike channels the first ones."""
    layers, height, width, _ = texels.shape
    write_exr(path, np.ascontiguousarray(texels.reshape(layers * height, width, -1)[..., : len(channels)]), channels, half=half)
