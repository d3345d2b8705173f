"""A service to test against: its routes in this process, or the whole of it as a process of its own."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from service.app import create_app
from service.parts import Service
from service.settings import Settings
from tests.service.running import BOX, InProcess, Server


@pytest.fixture
def make_server(tmp_path: Path) -> Iterator[Callable[..., Server]]:
    """Start services that end with the test."""
    servers: list[Server] = []

    def make(name: str = "data", *options: str) -> Server:
        servers.append(Server(tmp_path / name, *options))
        return servers[-1]

    yield make
    for server in servers:
        server.close()


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A service for a whole module of tests that do it no harm."""
    server = Server(tmp_path_factory.mktemp("service") / "data")
    server.wait_ready()
    yield server
    server.close()


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    """The parts of a service whose scheduler does not run: jobs stay queued."""
    service = Service(Settings(data=str(tmp_path / "data")))
    yield service
    service.close()


@pytest.fixture
def http(service: Service) -> InProcess:
    """The routes in this process."""
    return InProcess(create_app(service))


@pytest.fixture
def box(tmp_path: Path) -> Path:
    """A small scene as a file."""
    path = tmp_path / "box.glb"
    path.write_bytes(BOX)
    return path
