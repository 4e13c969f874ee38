"""Bodies of requests, as they come in."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, GetJsonSchemaHandler, JsonValue, RootModel
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from rsavatar.spec import JobSpec, resolve
from services.api.deps import UUID
from services.errors import RequestError
from services.store.listing import SORTS
from services.store.query import LONGEST
from services.store.records import State

NAMES = ("method", "subject", "preset")
SORT = f"^-?({'|'.join(SORTS)})$"
SUBJECT_NAME = r"^[A-Za-z0-9][A-Za-z0-9._-]*$"
KEY = re.compile(r"[\x21-\x7e]{1,255}")


class JobRequest(RootModel[dict[str, JsonValue]]):
    """A partial JobSpec: what it does not name comes from the preset."""

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """Shown as the spec itself, of which two fields are required."""
        shown = handler.resolve_ref_schema(handler(JobSpec.__pydantic_core_schema__))
        return {**shown, "title": "JobRequest", "required": ["method", "subject"]}

    def resolve(self) -> JobSpec:
        """The complete spec.

        Raises:
            SpecError: naming every offending field.
            RequestError: if a name is not text.
        """
        for name in NAMES:
            value = self.root.get(name)
            if value is not None and not isinstance(value, str):
                raise RequestError(name, "text", repr(value))
        return resolve(self.root)

    def sha256(self) -> str:
        """Hash of the request as it came, by which a repeated idempotency key is judged."""
        return canonical_sha256(self.root)


def canonical_sha256(value: Mapping[str, Any]) -> str:
    """SHA-256 of JSON with sorted keys."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def checked_key(key: str | None) -> str | None:
    """An idempotency key.

    Raises:
        RequestError: unless it is 1 to 255 printable ASCII characters.
    """
    if key is not None and not KEY.fullmatch(key):
        raise RequestError("Idempotency-Key", "1 to 255 printable ASCII characters without spaces", repr(key))
    return key


class JobQuery(BaseModel):
    """Which jobs a listing shows."""

    model_config = ConfigDict(extra="forbid")

    state: State | None = None
    method: str | None = Field(None, max_length=64)
    subject: str | None = Field(None, max_length=128)
    grid: str | None = Field(None, pattern=UUID)
    q: str | None = Field(None, max_length=LONGEST, description="filter, such as: state:failed psnr>25 tag:paper")
    sort: str = Field("-submitted", pattern=SORT, description="a key, with - for the largest first")
    cursor: str | None = Field(None, pattern=UUID, description="next_cursor of the page before")
    limit: int = Field(50, ge=1, le=200)


class SubjectRequest(BaseModel):
    """A directory on the service's machine, to be known under a name."""

    model_config = ConfigDict(extra="forbid")

    name: str = Field(min_length=1, max_length=128, pattern=SUBJECT_NAME)
    path: str = Field(min_length=1, max_length=4096)
