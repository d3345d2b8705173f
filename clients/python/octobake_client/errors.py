"""Everything that the client raises on purpose.

OctobakeClientError
├── ServiceError     the service answered with a problem
├── Unreachable      nobody answered
├── TransferError    bytes arrived that are not the ones asked for
└── JobFailed        a job has finished, and not with success
"""

from __future__ import annotations

import json

import httpx


class OctobakeClientError(Exception):
    """Base of the client's errors.

    Parameters
    ----------
    slug : str
        The service's stable name of the error; branch on it.
    message : str
        For a person.
    where : str
        The file, node, field or URL at fault; may be empty.
    """

    def __init__(self, slug: str, message: str, where: str = "") -> None:
        super().__init__(f"{where}: {message}" if where else message)
        self.slug = slug
        self.message = message
        self.where = where


class ServiceError(OctobakeClientError):
    """An RFC 9457 problem; `status` is its HTTP status."""

    def __init__(self, slug: str, message: str, where: str = "", status: int = 500) -> None:
        super().__init__(slug, message, where)
        self.status = status

    @classmethod
    def of(cls, response: httpx.Response) -> ServiceError:
        """From an answer that has been read; one that is no problem document, a proxy's perhaps, is told as it stands."""
        try:
            problem = json.loads(response.text)
            return cls(problem["slug"], problem["detail"], problem["where"], response.status_code)
        except (ValueError, KeyError, TypeError):
            text = f"answered {response.status_code} {response.reason_phrase}; is this an octobake service?"
            return cls("client.not_octobake", text, str(response.url), response.status_code)


class Unreachable(OctobakeClientError):
    """No connection, or one that broke and could not be made again in time."""

    def __init__(self, url: str, reason: str) -> None:
        super().__init__("client.unreachable", f"no answer from the service ({reason}); is it running?", url)


class TransferError(OctobakeClientError):
    """A download or an upload whose bytes do not have their digest."""


class JobFailed(OctobakeClientError):
    """A job that has failed or was cancelled; slug, where and message are the job's own.

    `exit_code` is what `octobake bake` would have exited with.
    """

    def __init__(self, slug: str, message: str, where: str, exit_code: int) -> None:
        super().__init__(slug, message, where)
        self.exit_code = exit_code
