"""Clean-ups: what the next one would take, and one at once."""

from __future__ import annotations

from fastapi import APIRouter

from service import documents, retention
from service.routes.common import Here

router = APIRouter(prefix="/v1/cleanup", tags=["cleanup"])


@router.get("", operation_id="previewCleanup", summary="What a clean-up would take")
def preview_cleanup(service: Here) -> documents.Cleanup:
    """Answer which jobs would expire now, and how many files would go; nothing goes."""
    return _document(service.retention.preview())


@router.post("", operation_id="cleanUp", summary="Clean up now")
def clean_up(service: Here) -> documents.Cleanup:
    """Take what has outlived its time, as the service does by the hour; answers what was taken."""
    taken = service.retention.clean()
    for job in taken.jobs:
        service.hub.tell(job)
    return _document(taken)


def _document(taken: retention.Cleanup) -> documents.Cleanup:
    return documents.Cleanup(
        jobs=list(taken.jobs),
        forgotten=list(taken.forgotten),
        scenes=list(taken.scenes),
        blobs=len(taken.blobs),
        bytes=sum(taken.blobs.values()),
    )
