"""Every error that octobake raises on purpose.

OctobakeError
├── InputError        exit 2, HTTP 422: somebody's input is wrong; nothing was written
│   ├── SpecError     spec.*
│   ├── SceneError    scene.* and gltf.*
│   └── BundleError   bundle.*
├── BakeError         exit 3, HTTP 500: the work itself failed
├── MachineError      exit 3, HTTP 503: the machine lacks something (a Vulkan driver, disk space)
└── Cancelled         exit 3: somebody asked for the work to stop

An error has a stable `slug` (``gltf.index_out_of_range``), a `where` that names the file, node, field or probe, and a
message that says what to do. All three reach every client unchanged.
"""

from __future__ import annotations


class OctobakeError(Exception):
    """Base of all errors raised on purpose.

    Parameters
    ----------
    slug : str
        Stable name, ``area.reason`` in lower case with underscores; clients may branch on it.
    message : str
        One line for a person: what is wrong and what to do about it.
    where : str
        The place: ``accessors[3].count``, ``node 'Lamp'``, ``volumes[0].spacing``, a file name. May be empty.
    """

    exit_code = 3
    http_status = 500

    def __init__(self, slug: str, message: str, where: str = "") -> None:
        super().__init__(f"{where}: {message}" if where else message)
        self.slug = slug
        self.message = message
        self.where = where

    def __reduce__(self) -> tuple[type[OctobakeError], tuple[str, str, str]]:
        # Errors cross process borders (a worker's to the service): keep all three fields.
        return type(self), (self.slug, self.message, self.where)


class InputError(OctobakeError):
    """Somebody's input is wrong. Nothing was written."""

    exit_code = 2
    http_status = 422


class SpecError(InputError):
    """The spec is not one: unknown key, wrong type, value out of range."""


class SceneError(InputError):
    """The scene cannot be read, or uses what octobake does not support."""


class BundleError(InputError):
    """A bundle cannot be read, or is not one."""


class BakeError(OctobakeError):
    """The bake itself failed."""


class MachineError(OctobakeError):
    """This machine lacks something that the work needs."""

    http_status = 503


class Cancelled(OctobakeError):
    """Somebody asked for the work to stop."""

    def __init__(self, slug: str = "bake.cancelled", message: str = "cancelled on request", where: str = "") -> None:
        super().__init__(slug, message, where)
