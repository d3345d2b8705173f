"""``python -m tests.faults``: how many faults there are, and how many different slugs and places they must be refused with."""

from __future__ import annotations

from tests.faults.corpus import corpus
from tests.faults.documents import bundles, documents


def summary() -> str:
    """One line for each kind of input, and one for all."""
    rows = [("scenes", f.slug, f.where) for f in corpus()]
    rows += [(f.kind, f.slug, f.where) for f in documents()]
    rows += [("bundles", f.slug, "") for f in bundles()]
    lines = []
    for kind in [*dict.fromkeys(r[0] for r in rows), "all"]:
        mine = [r for r in rows if kind in (r[0], "all")]
        slugs, places = len({r[1] for r in mine}), len({r[1:] for r in mine})
        lines.append(f"{kind:<11}{len(mine):>5} faults, {slugs:>3} slugs, {places:>4} different slugs and places")
    return "\n".join(lines)


if __name__ == "__main__":
    print(summary())
