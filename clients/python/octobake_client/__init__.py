"""Python client of the octobake bake service: submit, wait, fetch."""

from octobake_client.client import Client
from octobake_client.errors import JobFailed, OctobakeClientError, ServiceError, TransferError, Unreachable
from octobake_client.jobs import Bake, Event, Job, Point, Progress, Scene, Verification

__version__ = "0.1.0"
__all__ = [
    "Bake",
    "Client",
    "Event",
    "Job",
    "JobFailed",
    "OctobakeClientError",
    "Point",
    "Progress",
    "Scene",
    "ServiceError",
    "TransferError",
    "Unreachable",
    "Verification",
]
