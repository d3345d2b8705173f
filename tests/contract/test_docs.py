"""The pages of the core say what the code does: every key, every default, every command; their example programs run."""

from __future__ import annotations

import json
import re
import shutil
from argparse import ArgumentParser, _HelpAction, _SubParsersAction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import BaseModel
from pydantic_core import PydanticUndefined

from bake_core import spec as specs
from bake_core.bake import bake
from bake_core.bundle import Bundle, read_bundle
from bake_core.examples import cornell
from bake_core.irradiance import sample
from bake_core.octahedral import oct_to_dir
from service.cli import COMMANDS, parser

ROOT = Path(__file__).resolve().parents[2]


def page(name: str) -> str:
    return (ROOT / "docs" / name).read_text(encoding="utf-8")


def rows(text: str) -> dict[str, list[str]]:
    """First cells in backticks of the tables in a text, each with the cells after it; a cell may name several."""
    found: dict[str, list[str]] = {}
    for line in text.splitlines():
        cells = [c.strip() for c in line.strip().strip("|").split(" | ")]
        if line.startswith("| `"):
            for key in re.findall(r"`([^`]+)`", cells[0]):
                found[key] = cells[1:]
    return found


# --- the spec --------------------------------------------------------------------------------------------------------------------------

MODELS = [
    ("## Spec", specs.Spec),
    ("## Volume", specs.Volume),
    ('`"kind": "constant"`', specs.ConstantEnvironment),
    ('`"kind": "equirect"`', specs.EquirectEnvironment),
    ('`"kind": "directional"`', specs.DirectionalLight),
    ('`"kind": "point"`', specs.PointLight),
    ('`"kind": "spot"`', specs.SpotLight),
    ("## Resolution", specs.Resolution),
    ("## Stop", specs.Stop),
]


@pytest.mark.parametrize(("heading", "model"), MODELS, ids=lambda v: getattr(v, "__name__", ""))
def test_every_key_of_the_spec_is_documented_with_its_default(heading: str, model: type[BaseModel]) -> None:
    text = page("spec.md")
    start = text.index("\n" + heading)
    table = text[start:].split("\n|", 1)[1].split("\n\n", 1)[0]
    described = rows("|" + table)
    assert set(described) == set(model.model_fields)
    for key, field in model.model_fields.items():
        told = described[key][0]
        if isinstance(field.default, BaseModel) and told == "see below":
            continue
        if field.default is PydanticUndefined:
            assert told == "required", key
        else:
            default = field.default.model_dump(mode="json") if isinstance(field.default, BaseModel) else field.default
            assert told == f"`{json.dumps(default)}`", key


def test_every_model_of_the_spec_is_on_the_page() -> None:
    ours = {m for m in vars(specs).values() if isinstance(m, type) and issubclass(m, BaseModel) and m.__module__ == specs.__name__}
    assert {m for m in ours if not m.__name__.startswith("_")} == {m for _, m in MODELS}


def test_examples_of_specs_are_specs() -> None:
    blocks = re.findall(r"```json\n(.*?)```", page("spec.md"), re.DOTALL)
    assert len(blocks) == 2
    for block in blocks:
        specs.parse_spec(json.loads(block))


def test_every_slug_of_the_spec_is_documented() -> None:
    used = {slug for slug in slugs() if slug.startswith("spec.")}
    assert set(re.findall(r"`(spec\.[a-z_]+)`", page("spec.md").split("## Every slug")[1])) == used


# --- errors ----------------------------------------------------------------------------------------------------------------------------

# Words with a dot that are names of files, of modules or of places in a request.
NO_SLUGS = (
    r"(json|html|glb|gltf|zip|glsl|vert|frag|log|js|css|exr|cli|url|id|scene|bake|cameras|thresholds|worker_process|reader_process|txt)"
)
AREAS = (
    "bake|bench|blob|bundle|camera|client|compute|demo|gltf|job|machine|request|sample|scene|service|settings|shaders|spec|thresholds|token"
    "|verification|vulkan"
)


def slugs() -> set[str]:
    """Every slug that the code can raise."""
    texts = {p: p.read_text(encoding="utf-8") for top in ("bake_core", "service", "clients/python") for p in (ROOT / top).rglob("*.py")}
    everything = "".join(texts.values())
    found = {s for s in re.findall(rf'"((?:{AREAS})\.[a-z_]+)"', everything) if not re.fullmatch(rf"[a-z]+\.{NO_SLUGS}", s)}
    # Those that are put together: the reader's, the strict JSON parser's, and the texels' of a sky.
    reader = "".join(t for p, t in texts.items() if p.parent.name == "gltf")
    found |= {f"gltf.{s}" for s in re.findall(r'fail\(\s*"([a-z_]+)"', reader) + re.findall(r'\("(unsupported_[a-z_]+)"', reader)}
    strict = re.findall(r'f"\{area\}\.([a-z_]+)"', texts[ROOT / "bake_core" / "strict_json.py"])
    areas = re.findall(r'strict_json\.parse\([^"]*"([a-z]+)"', everything) + re.findall(r'parse\([^"\n]*SceneError, "([a-z]+)"', reader)
    found |= {f"{area}.{slug}" for area in areas for slug in strict}
    found |= {f"spec.image_{s}" for s in re.findall(r'"([a-z_]+)", "is (?:not finite|negative)"', everything)}
    return found - {"spec.image_"}


def test_every_slug_is_documented_and_no_other() -> None:
    text = "".join(page(name) for name in ("errors.md", "spec.md", "scenes.md"))
    told = set(re.findall(rf"`((?:{AREAS})\.[a-z_]+)`", text))
    told = {s for s in told if not re.fullmatch(rf"[a-z]+\.{NO_SLUGS}", s)}
    general = re.compile(r"[a-z]+\.(bad_json|json_too_deep|duplicate_key|not_finite)")
    assert {s for s in slugs() - told if not general.fullmatch(s)} == set()
    assert told - slugs() == set()


# --- the bundle ------------------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def baked(tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    """All outputs of a few probes of the Cornell box, in an odd grid, one of them inside a block."""
    folder = tmp_path_factory.mktemp("docs")
    glb, document = cornell()
    (folder / "scene.glb").write_bytes(glb)
    grid = {"name": "room", "origin": [-0.4, 0.3, -0.4], "spacing": [0.5, 0.4, 0.6], "counts": [3, 2, 2]}
    outputs = ["irradiance", "visibility", "radiance", "distance", "normal"]
    small = {"distance": 16, "normal": 8, "visibility": 8}
    stop = {"target_error": None, "max_samples": 4}
    spec = specs.parse_spec({**document, "volumes": [grid], "outputs": outputs, "resolution": small, "stop": stop})
    bake(folder / "scene.glb", spec, folder / "bundle")
    return read_bundle(folder / "bundle")


def keys(document: Any, skip: tuple[str, ...]) -> set[str]:
    """Every key of a JSON document, apart from what lies under some of them."""
    if isinstance(document, list):
        return set().union(*(keys(d, skip) for d in document))
    if not isinstance(document, dict):
        return set()
    return set(document).union(*(keys(v, skip) for k, v in document.items() if k not in skip))


def test_every_key_of_the_manifest_is_documented(baked: Bundle) -> None:
    text = page("bundle.md").split("## manifest.json")[1].split("## Identity")[0]
    documented = set(re.findall(r"`([a-z_0-9]+)`", text))
    manifest = {**baked.manifest, "files": list(baked.manifest["files"].values())}
    assert keys(manifest, ("spec",)) <= documented


def test_channels_and_files_are_documented(baked: Bundle) -> None:
    text = page("bundle.md")
    for atlas in baked.manifest["volumes"][0]["atlases"]:
        assert f"`{atlas['output']}` | " + ", ".join(f"`{c}`" for c in atlas["channels"]) in text
        assert f"`VOLUME.{atlas['output']}.exr`" in text or "VOLUME.OUTPUT.exr" in text


def test_the_reader_on_the_page_reads_a_bundle(baked: Bundle) -> None:
    """Run as it stands, against our own reader; its look-up against the irradiance query at probes, where the answer is the probe's own."""
    (code,) = re.findall(r"```python\n(.*?)```", page("bundle.md"), re.DOTALL)
    names: dict[str, Any] = {}
    exec(compile(code, "bundle.md", "exec"), names)
    manifest, tiles = names["read"](baked.path)
    assert manifest == baked.manifest
    volume = baked.volumes[0]
    assert {output for _, output in tiles} == set(volume.atlases) and len(tiles) == 6
    for output, atlas in volume.atlases.items():
        found = tiles["room", output]
        assert found.shape == (12, atlas.tile, atlas.tile, atlas.texels.shape[-1])
        for p, tile in enumerate(volume.tiles):
            if tile < 0:
                assert not found[p].any()
                continue
            layer, place = divmod(tile, atlas.columns * atlas.rows)
            row, column = divmod(place, atlas.columns)
            at = np.s_[layer, row * atlas.tile : (row + 1) * atlas.tile, column * atlas.tile : (column + 1) * atlas.tile]
            np.testing.assert_array_equal(found[p], atlas.texels[at])
    active = np.flatnonzero(volume.states == 1)
    index = np.stack(np.unravel_index(active, volume.counts[::-1])[::-1], -1)
    positions = volume.origin + index * volume.spacing
    random = np.random.default_rng(0)
    for normal in [*oct_to_dir(random.uniform(-1, 1, (40, 2))), [0, 0, -1], [0, 1, 0], [-1, 0, 0], [0, 0.6, -0.8]]:
        truth = sample(baked.volumes, positions, np.tile(normal, (len(positions), 1))).irradiance
        answer = [names["look_up"](tiles["room", "irradiance"][p], np.array(normal, np.float64)) for p in active]
        np.testing.assert_allclose(answer, truth, rtol=1e-9, atol=1e-12)


def test_the_reader_on_the_page_refuses_another_version(baked: Bundle, tmp_path: Path) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", page("bundle.md"), re.DOTALL)
    assert len([line for line in code.splitlines() if line.strip()]) <= 40
    names: dict[str, Any] = {}
    exec(compile(code, "bundle.md", "exec"), names)
    shutil.copytree(baked.path, tmp_path / "copy")
    (tmp_path / "copy" / "manifest.json").write_text(json.dumps({**baked.manifest, "version": 1}))
    with pytest.raises(ValueError, match="not a bundle"):
        names["read"](tmp_path / "copy")


def test_the_border_rule_on_the_page_is_the_one_in_the_files(baked: Bundle) -> None:
    """Its equations, typed as they stand there."""
    for atlas in baked.volumes[0].atlases.values():
        t, n = atlas.texels[0, : atlas.tile, : atlas.tile], atlas.interior
        for i in range(1, n + 1):
            np.testing.assert_array_equal(t[0][i], t[1][n + 1 - i])
            np.testing.assert_array_equal(t[n + 1][i], t[n][n + 1 - i])
            np.testing.assert_array_equal(t[i][0], t[n + 1 - i][1])
            np.testing.assert_array_equal(t[i][n + 1], t[n + 1 - i][n])
        np.testing.assert_array_equal(t[0][0], t[n][n])
        np.testing.assert_array_equal(t[n + 1][n + 1], t[1][1])
        np.testing.assert_array_equal(t[0][n + 1], t[n][1])
        np.testing.assert_array_equal(t[n + 1][0], t[1][n])


# --- the command line ------------------------------------------------------------------------------------------------------------------


def commands() -> dict[str, ArgumentParser]:
    (choices,) = (a.choices for a in parser()._actions if isinstance(a, _SubParsersAction))
    return dict(choices)


def test_every_command_and_option_is_documented() -> None:
    text = page("cli.md")
    assert tuple(re.findall(r"^## octobake ([a-z-]+)$", text, re.MULTILINE)) == COMMANDS
    sections = dict(zip(COMMANDS, re.split(r"^## octobake [a-z-]+$", text, flags=re.MULTILINE)[1:], strict=True))
    for name, command in commands().items():
        section = sections[name]
        verbs = [verb for a in command._actions if isinstance(a, _SubParsersAction) for verb in a.choices.values()]
        actions = [a for c in (command, *verbs) for a in c._actions if not isinstance(a, _HelpAction)]
        words = [w for a in actions for w in (a.option_strings or [str(a.metavar or a.dest)])]
        for word in words:
            # The service's settings have a page, and a test, of their own.
            if name != "serve" or word == "--ready-file":
                assert re.search(rf"`{re.escape(word)}[` ]", section), f"docs/cli.md says nothing of {word} under octobake {name}"
        assert set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", section)) <= set(words), name


def test_exit_codes_are_documented() -> None:
    from service.cli import EXIT_CODES

    documented = rows(page("cli.md").split("## octobake")[0])
    assert {int(c) for c in re.findall(r"\b(\d)\b", EXIT_CODES)} <= {int(k) for k in documented}
    assert "130" in documented


def test_every_stability_case_is_on_its_page() -> None:
    from bake_core.stability.run import CASES

    (printed,) = re.findall(r"```\n(case .*?)```", page("stability.md"), re.DOTALL)
    listed = [re.split(r"  +", line)[0] for line in printed.splitlines()[1:]]
    assert listed == [c.name for c in CASES], "run: octobake stability, and put its table on the page"
