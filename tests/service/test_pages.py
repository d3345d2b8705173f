"""The service's pages as a browser shows them, in headless Chromium."""

from __future__ import annotations

import re

import pytest
from octobake_client import Bake, JobFailed

from tests import chromium
from tests.service.figures.work import add_box
from tests.service.running import Server, box_spec

# Of the page's own time, which runs ahead while nothing is on its way: until all that it asks for has come.
ENOUGH = "--virtual-time-budget=10000"


def seen(server: Server, path: str) -> str:
    """What stands in a page's body, without what is hidden."""
    html = chromium.document(server.url + path, ENOUGH)
    return re.sub(r"<(img|form|progress)[^>]*hidden[^>]*>", "", html[html.index("<body") :])


def test_pages_tell_how_a_bake_went(server: Server) -> None:
    chromium.needed("a browser")
    with server.client() as client:
        scene = add_box(server)
        good = client.wait(client.submit(scene, box_spec(32, (2, 2, 2)))).check()
        body = {"scene": scene, "spec": box_spec(48, (2, 2, 2)), "limits": {"memory_bytes": 1 << 20}}
        bad = Bake.of(client._send("POST", "/v1/bakes", json=body).json())
        with pytest.raises(JobFailed):
            client.wait(bad).check()
    page = seen(server, f"/web/bakes/{good.id}")
    assert "succeeded" in page and "Loading" not in page
    assert f"/v1/bakes/{good.id}/bundle" in page
    assert "curve.svg?samples=32" in page and "/preview?samples=32" in page
    assert re.search(r"<td>32</td><td>[\d,]+</td><td>[\d.]+</td>", page)
    page = seen(server, f"/web/bakes/{bad.id}")
    assert "failed: [job.over_memory]" in page and "curve.svg" not in page
    page = seen(server, "/")
    assert good.id in page and bad.id in page and "succeeded" in page
    assert "no bake" in seen(server, "/web/bakes/unknown")
