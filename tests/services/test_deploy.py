"""The deployment files are parsed, not run: their commands, settings and limits are those that exist."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from services.settings import Settings

ROOT = Path(__file__).resolve().parents[2]
COMPOSE: dict[str, Any] = yaml.safe_load((ROOT / "docker-compose.yml").read_text("utf-8"))
DOCKERFILE = (ROOT / "deploy" / "docker" / "Dockerfile").read_text("utf-8")
OURS = ("migrate", "api", "worker")


def has_entry(module: str) -> bool:
    found = importlib.util.find_spec(module)
    if found is not None and found.submodule_search_locations:
        return importlib.util.find_spec(f"{module}.__main__") is not None
    return found is not None


@pytest.mark.parametrize("name", OURS)
def test_commands_exist(name: str) -> None:
    service = COMPOSE["services"][name]
    assert service["command"][:2] == ["python", "-m"]
    assert has_entry(service["command"][2])
    assert f"FROM base AS {service['build']['target']}\n" in DOCKERFILE
    assert (ROOT / service["build"]["dockerfile"]).is_file()


@pytest.mark.parametrize("name", OURS)
def test_settings_exist_and_are_valid(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    known = {f"RSAVATAR_{field.upper()}" for field in Settings.model_fields}
    environment = COMPOSE["services"][name]["environment"]
    assert set(environment) <= known
    for key, value in environment.items():
        monkeypatch.setenv(key, str(value))
    settings = Settings()
    assert not settings.embedded_broker
    assert not settings.embedded_database
    assert settings.needs_token or name != "api"


@pytest.mark.parametrize("name", OURS)
def test_our_containers_may_do_little(name: str) -> None:
    service = COMPOSE["services"][name]
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert service["user"] == "10001:10001"
    assert service["security_opt"] == ["no-new-privileges:true"]


@pytest.mark.parametrize("name", list(COMPOSE["services"]))
def test_everything_is_limited_and_watched(name: str) -> None:
    service = COMPOSE["services"][name]
    assert set(service["deploy"]["resources"]["limits"]) == {"cpus", "memory"}
    assert "healthcheck" in service or name == "migrate"
    for other, how in service.get("depends_on", {}).items():
        once = how["condition"] == "service_completed_successfully"
        assert once if other == "migrate" else "healthcheck" in COMPOSE["services"][other]


def test_only_the_api_is_published_and_only_on_loopback() -> None:
    published = {name: s["ports"] for name, s in COMPOSE["services"].items() if "ports" in s}
    assert published == {"api": ["127.0.0.1:8000:8000"]}
    assert COMPOSE["networks"]["inside"] == {"internal": True}


def test_a_worker_has_time_for_its_checkpoint() -> None:
    worker = COMPOSE["services"]["worker"]
    grace = int(worker["environment"]["RSAVATAR_GRACE_SECONDS"])
    assert int(worker["stop_grace_period"].rstrip("s")) > grace + 20
    limit = int(worker["deploy"]["resources"]["limits"]["memory"].rstrip("g")) << 10
    assert int(worker["environment"]["RSAVATAR_MEMORY_LIMIT_MB"]) < limit


def test_images_run_as_nobody_and_the_api_has_no_torch() -> None:
    for target in ("api", "worker"):
        stage = re.split(r"^FROM ", DOCKERFILE, flags=re.MULTILINE)
        (body,) = (s for s in stage if s.startswith(f"base AS {target}\n"))
        assert "USER 10001:10001" in body
    (api,) = (s for s in re.split(r"^FROM ", DOCKERFILE, flags=re.MULTILINE) if s.startswith("build AS build-api"))
    assert ".[api]" in api
    assert "worker" not in api
    assert "core" not in api
