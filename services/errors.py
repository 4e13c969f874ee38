"""The exception tree of the service. Every message reads: name, expected, got.

ServiceError
├── SettingsError     a setting is missing, contradicts another one, or would be unsafe
├── SchemaError       the database is not at the version that this code was written for
├── BrokerError       no redis-server can be found, or it does not answer
├── NotFoundError     no such job, subject, artifact or table
├── ConflictError     the verb does not fit the job's state
├── ForbiddenError    the caller may not do that
├── RequestError      a request contradicts the catalogue, or an earlier request with the same key
├── RenderError       nothing can be drawn now: the render process does not start, or does not answer
├── QuotaError        an owner has as many jobs as they may
├── BackupError       a backup is damaged, or cannot be made or restored
└── FencedError       this attempt no longer owns its job; nothing it says is stored
"""

from __future__ import annotations

from rsavatar.errors import expected


class ServiceError(Exception):
    """Base of all errors that the service raises on purpose."""

    def __init__(self, name: str, wanted: object, got: object) -> None:
        super().__init__(expected(name, wanted, got))
        self.name = name
        self.expected = str(wanted)
        self.got = str(got)


class SettingsError(ServiceError):
    """A setting is missing, contradicts another one, or would be unsafe."""


class SchemaError(ServiceError):
    """The database is not at the version that this code was written for."""


class BrokerError(ServiceError):
    """No redis-server can be found, or it does not answer."""


class NotFoundError(ServiceError):
    """No such job, subject, artifact or table."""


class ConflictError(ServiceError):
    """The verb does not fit the job's state."""


class ForbiddenError(ServiceError):
    """The caller may not do that."""


class RequestError(ServiceError):
    """A request contradicts the catalogue, or an earlier request with the same key."""


class RenderError(ServiceError):
    """Nothing can be drawn now: the render process does not start, has no turn, or does not answer."""


class QuotaError(ServiceError):
    """An owner has as many jobs as they may."""


class FencedError(ServiceError):
    """An attempt that no longer owns its job; nothing it says is stored."""


class BackupError(ServiceError):
    """A backup is damaged, or cannot be made or restored."""
