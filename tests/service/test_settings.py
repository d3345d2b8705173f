"""The one list of settings: documented, and refused where it is wrong."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from bake_core.errors import InputError
from service.cli import parser
from service.settings import ENVIRONMENT_PREFIX, Settings, load, settings_list

DOCS = Path(__file__).resolve().parents[2] / "docs" / "settings.md"


def test_every_setting_is_documented_with_its_default() -> None:
    rows = re.findall(r"^\| `--([a-z-]+)` \| `(OCTOBAKE_[A-Z_]+)` \| (.*?) \| (.*?) \|$", DOCS.read_text(), re.MULTILINE)
    names = [f.name for f in settings_list()]
    assert [option.replace("-", "_") for option, *_ in rows] == names
    assert [variable for _, variable, *_ in rows] == [ENVIRONMENT_PREFIX + n.upper() for n in names]
    assert [default for *_, default, _ in rows] == [f"`{f.default}`" if f.default != "" else "" for f in settings_list()]
    assert [text for *_, text in rows] == [f.metadata["help"] for f in settings_list()]


def test_every_setting_is_an_option_of_serve() -> None:
    args = parser().parse_args(["serve", *(part for f in settings_list() for part in ("--" + f.name.replace("_", "-"), "7"))])
    assert load(vars(args), {}) == Settings(**{f.name: type(f.default)(7) for f in settings_list()})  # type: ignore[misc]


def test_an_option_goes_before_the_environment() -> None:
    environment = {"OCTOBAKE_PORT": "1", "OCTOBAKE_THREADS": "3", "OCTOBAKE_SERVER": "http://elsewhere"}
    settings = load({"port": "2", "threads": None}, environment)
    assert (settings.port, settings.threads, settings.host) == (2, 3, "127.0.0.1")


@pytest.mark.parametrize(
    ("options", "environment", "slug", "where"),
    [
        ({"port": "x"}, {}, "settings.invalid", "--port"),
        ({"port": "65536"}, {}, "settings.invalid", "--port"),
        ({"max_attempts": "0"}, {}, "settings.invalid", "--max-attempts"),
        ({}, {"OCTOBAKE_SHARD_SECONDS": "nan"}, "settings.invalid", "OCTOBAKE_SHARD_SECONDS"),
        ({}, {"OCTOBAKE_PROT": "1"}, "settings.unknown", "OCTOBAKE_PROT"),
    ],
)
def test_a_setting_that_cannot_be(options: dict[str, str], environment: dict[str, str], slug: str, where: str) -> None:
    with pytest.raises(InputError) as caught:
        load(options, environment)
    assert (caught.value.slug, caught.value.where) == (slug, where)
