"""What can be asked for: methods, presets, the spec's schema."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter

from rsavatar.catalog import DESCRIPTIONS, METHODS
from rsavatar.spec import FLAGS_OF_METHOD, JobSpec, presets_dir, read_preset
from services.api.views import MethodView

router = APIRouter(tags=["catalogue"])


@router.get("/methods")
def list_methods() -> list[MethodView]:
    """Methods with a sentence each and the components that they can lose."""
    flags = {name: sorted(FLAGS_OF_METHOD.get(name, frozenset())) for name in METHODS}
    return [MethodView(name=n, description=DESCRIPTIONS.get(n, ""), ablation_flags=flags[n]) for n in METHODS]


@router.get("/presets")
def list_presets() -> dict[str, dict[str, Any]]:
    """Presets and the values that they give to what a request does not name."""
    return {path.stem: read_preset(path.stem) for path in sorted(presets_dir().glob("*.toml"))}


@router.get("/spec/schema")
def get_schema() -> dict[str, Any]:
    """JSON schema of a complete JobSpec."""
    return JobSpec.model_json_schema(by_alias=True)
