"""The exception tree of the core. Every message reads: name, expected, got.

RsAvatarError
├── SpecError         a job description is unknown, malformed or contradicts itself
├── DataError         a subject, image, mask, fit or camera is missing, truncated or in the wrong unit
├── BodyError         a body model file cannot be used
├── CheckpointError   a checkpoint is damaged, or belongs to another spec or code version
├── KernelError       the native kernels are missing, or refused their input
├── DivergedError     training left the finite numbers and could not be brought back
├── ClientError       the service refused a request, or cannot be reached
└── Interrupted       somebody asked the job to stop; its checkpoint is on disk
"""

from __future__ import annotations


class RsAvatarError(Exception):
    """Base of all errors that this package raises on purpose."""


class SpecError(RsAvatarError):
    """A job description is unknown, malformed or contradicts itself."""


class DataError(RsAvatarError):
    """A subject, image, mask, fit or camera cannot be used."""


class BodyError(RsAvatarError):
    """A body model file cannot be used."""


class CheckpointError(RsAvatarError):
    """A checkpoint is damaged, or belongs to another spec or code version."""


class KernelError(RsAvatarError):
    """The native kernels are missing, or refused their input."""


class DivergedError(RsAvatarError):
    """Training left the finite numbers and could not be brought back."""


class ClientError(RsAvatarError):
    """The service refused a request, or cannot be reached; ``title`` and ``detail`` are those of its problem."""

    def __init__(self, title: str, detail: str = "", status: int | None = None) -> None:
        super().__init__(f"{title}: {detail}" if detail else title)
        self.title = title
        self.detail = detail
        self.status = status


class Interrupted(RsAvatarError):
    """Somebody asked the job to stop; its checkpoint is on disk."""


def expected(name: str, wanted: object, got: object) -> str:
    """The one shape of a message about a bad value: ``name: expected WANTED, got GOT``."""
    return f"{name}: expected {wanted}, got {got}"
