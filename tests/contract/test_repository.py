"""The repository itself: pins, paths, packaging, layers."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
import zipfile
from importlib.metadata import entry_points, packages_distributions
from itertools import chain
from pathlib import Path
from typing import Any

import pytest

from bake_core.shader_files import shader_dir
from service.cli import COMMANDS

ROOT = Path(__file__).resolve().parents[2]
LOCKS = ("requirements.txt", "requirements-dev.txt")
# Which distribution brings a package, where their names differ.
NAME = re.compile(r"[A-Za-z0-9._-]+")
PEER_PROGRAMS = [ROOT / "bake_core" / "bench" / f"{name}_peer.py" for name in ("mitsuba", "cycles")]


def project(folder: str = ".") -> dict[str, Any]:
    return tomllib.loads((ROOT / folder / "pyproject.toml").read_text())


def normal(name: str) -> str:
    """PEP 503: Open_ImageIO, open.imageio and open-imageio are one distribution."""
    return re.sub(r"[-_.]+", "-", name).lower()


def pins(lock: str) -> dict[str, list[str]]:
    """Requirement lines of a lock file, each with its hashes."""
    found: dict[str, list[str]] = {}
    for line in (ROOT / lock).read_text().replace("\\\n", " ").splitlines():
        if line and not line.lstrip().startswith("#"):
            requirement, *hashes = re.split(r"\s+--hash=", line.strip())
            found[requirement] = hashes
    return found


def tracked() -> list[Path]:
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("not a git checkout: there is no list of what belongs to the repository")
    return [ROOT / name for name in listed.stdout.split("\0") if name and (ROOT / name).is_file()]


@pytest.mark.parametrize("lock", LOCKS)
def test_every_pin_is_exact_and_hashed(lock: str) -> None:
    assert pins(lock)
    for requirement, hashes in pins(lock).items():
        assert re.match(r"^[a-z0-9._-]+==[0-9][^ ]*( ;.*)?$", requirement), requirement
        assert hashes, f"{requirement} has no hash"
        assert all(re.fullmatch(r"sha256:[0-9a-f]{64}", h) for h in hashes)


@pytest.mark.parametrize("lock", LOCKS)
def test_locks_say_what_but_not_from_where(lock: str) -> None:
    text = (ROOT / lock).read_text()
    assert "://" not in text
    assert not re.search(r"^\s*(-i|-f|--(extra-)?index-url|--find-links|--trusted-host)\b", text, re.MULTILINE)


def test_locks_agree_where_they_overlap() -> None:
    runtime, dev = ({r.split("==")[0] for r in pins(lock)} for lock in LOCKS)
    assert {r for r in pins(LOCKS[0]) if r.split("==")[0] in dev} == {r for r in pins(LOCKS[1]) if r.split("==")[0] in runtime}


def test_every_direct_dependency_is_locked() -> None:
    def names(requirements: list[str]) -> set[str]:
        return {normal(NAME.match(r).group()) for r in requirements}  # type: ignore[union-attr]

    locked = [{normal(r.split("==")[0]) for r in pins(lock)} for lock in LOCKS]
    assert names(project()["project"]["dependencies"]) | names(project("clients/python")["project"]["dependencies"]) <= locked[0]
    assert names(project()["dependency-groups"]["dev"]) <= locked[1]
    assert names(project()["build-system"]["requires"]) | names(project("clients/python")["build-system"]["requires"]) <= locked[1]


@pytest.mark.parametrize(("folder", "packages"), [(".", ("bake_core", "service")), ("clients/python", ("clients/python/octobake_client",))])
def test_every_import_is_declared(folder: str, packages: tuple[str, ...]) -> None:
    """What a package imports it declares, and does not borrow from what some dependency happens to bring.

    The peers' programs are run by other interpreters, which have those renderers: what they import is not ours to declare, and they may
    import nothing of ours, which is not there.
    """
    declared = {normal(NAME.match(r).group()) for r in project(folder)["project"]["dependencies"]}  # type: ignore[union-attr]
    ours = {"bake_core", "service", "octobake_client"}
    distributions = packages_distributions()
    for path in chain.from_iterable((ROOT / p).rglob("*.py") for p in packages):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                modules = [a.name for a in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                modules = [node.module]
            else:
                continue
            tops = {m.split(".")[0] for m in modules} - sys.stdlib_module_names
            if path in PEER_PROGRAMS:
                assert not tops & ours, f"{path.relative_to(ROOT)}:{node.lineno} imports what is not there"
                continue
            for top in tops - ours:
                brought_by = {normal(d) for d in distributions.get(top, [])}
                assert brought_by & declared, f"{path.relative_to(ROOT)}:{node.lineno} imports {top}: declare it in {folder}/pyproject.toml"


def test_no_paths_of_one_machine_and_no_hosts_of_package_indexes() -> None:
    # The patterns are put together here so that this file does not hold what it looks for.
    machine = re.compile(r"(^|[^A-Za-z0-9_.])/(" + "|".join(("root", "work", "farm", "home")) + r")/[A-Za-z]")
    index = re.compile("|".join(("pypi" + r"\.org", "pythonhosted" + r"\.org", "deb" + r"\.debian\.org", "registry" + r"\.npmjs")))
    for path in tracked():
        try:
            text = path.read_text()
        except UnicodeDecodeError:
            continue  # a picture
        for number, line in enumerate(text.splitlines(), 1):
            assert not machine.search(line), f"{path.relative_to(ROOT)}:{number} names a path of one machine"
            assert not index.search(line), f"{path.relative_to(ROOT)}:{number} names a package index"


def test_the_wheel_carries_shaders_pages_and_licence(tmp_path: Path) -> None:
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("octobake-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        packed = set(archive.namelist())
    sources = {p.relative_to(shader_dir()).as_posix() for p in shader_dir().rglob("*") if p.is_file()}
    assert sources
    assert {f"bake_core/_shaders/{s}" for s in sources} <= packed
    assert {p.relative_to(ROOT).as_posix() for p in (ROOT / "service").rglob("*") if p.is_file() and "__pycache__" not in p.parts} <= packed
    assert any(name.endswith("/LICENSE") for name in packed)
    assert not any(name.startswith(("tests/", "docs/", "clients/")) for name in packed)


def test_the_command_is_installed_and_the_readme_lists_it() -> None:
    (command,) = entry_points(group="console_scripts", name="octobake")
    assert command.value == "service.cli:main"
    listed = re.findall(r"^\| `octobake ([a-z-]+)", (ROOT / "README.md").read_text(), re.MULTILINE)
    assert set(listed) == set(COMMANDS)


def test_every_page_of_the_documentation_is_linked_from_its_index() -> None:
    index = (ROOT / "docs" / "README.md").read_text()
    for page in (ROOT / "docs").rglob("*.md"):
        if page.name != "README.md":
            assert f"({page.relative_to(ROOT / 'docs').as_posix()})" in index, f"docs/README.md does not link {page.name}"


@pytest.mark.parametrize("package", ["bake_core", "service"])
def test_the_architecture_page_places_every_module(package: str) -> None:
    page = (ROOT / "docs" / "architecture.md").read_text()
    for path in (ROOT / package).iterdir():
        if path.name[0] != "_" and (path.suffix == ".py" or (path / "__init__.py").exists()):
            assert re.search(rf"\b{path.stem}\b", page), f"{package}.{path.stem} has no place in docs/architecture.md"


def test_links_between_pages_lead_somewhere() -> None:
    for page in tracked():
        if page.suffix == ".md":
            for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text()):
                if "://" not in target:
                    assert (page.parent / target).exists(), f"{page.relative_to(ROOT)} links to {target}, which is not there"
