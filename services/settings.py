"""The one place where the service reads its environment: ``RSAVATAR_*`` variables become a frozen ``Settings``."""

from __future__ import annotations

import hashlib
import os
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, ValidationError, field_validator
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

from services.errors import SettingsError

SECRETS = ("DATABASE_URL", "BROKER_URL")
LOOPBACK = frozenset({"127.0.0.1", "localhost", "::1"})
LONGEST_SOCKET_PATH = 100  # sun_path holds 108 bytes on Linux, 104 on macOS
ROOT = Path(__file__).resolve().parent.parent  # children are started here, where `services` can be imported


class Settings(BaseSettings):
    """Every knob of the service. A field ``x`` is read from the variable ``RSAVATAR_X``."""

    model_config = SettingsConfigDict(env_prefix="RSAVATAR_", frozen=True, extra="ignore")

    home: Path = Field(default=Path("~/.local/share/rsavatar"), description="everything that is kept")
    database_url: str = Field(default="", description="SQLAlchemy URL; empty = SQLite in the home")
    broker_url: str = Field(default="", description="redis URL; empty = a private server on a unix socket in the home")
    artifacts_url: str = Field(default="", description="file:///DIR or s3://BUCKET/PREFIX; empty = in the home")
    redis_server: Path | None = Field(default=None, description="binary of the private server; none = look for one")
    subject_roots: Annotated[tuple[Path, ...], NoDecode] = Field(
        default=(), description="folders that hold subjects: those found are registered"
    )

    host: str = Field(default="127.0.0.1", description="address that the API binds")
    port: int = Field(default=8000, ge=0, le=65535, description="port that the API binds")
    require_token: bool = Field(default=False, description="ask for tokens on loopback too; elsewhere they always are")
    allowed_hosts: Annotated[tuple[str, ...], NoDecode] = Field(
        default=(), description="more names that a Host header may say"
    )
    session_hours: float = Field(default=12.0, gt=0, description="time after which a browser logs in again")
    requests_per_second: float = Field(default=50.0, gt=0, description="lasting pace of one token")
    request_burst: float = Field(default=200.0, ge=1, description="requests that one token may send at once")
    max_body_bytes: int = Field(default=65_536, ge=1024, description="largest request body, archives excepted")
    max_upload_bytes: int = Field(default=4 << 30, ge=1024, description="largest archive of a subject, as sent")
    max_subject_bytes: int = Field(default=8 << 30, ge=1024, description="largest subject, unpacked")
    max_entry_bytes: int = Field(default=256 << 20, ge=1024, description="largest file of a subject")
    max_entries: int = Field(default=50_000, ge=1, description="most files of a subject")
    check_seconds: float = Field(default=600.0, gt=0, description="time that the check of a subject may take")
    api_processes: int = Field(default=1, ge=1, le=64, description="processes of the API that share its port")
    max_grid_jobs: int = Field(default=1000, ge=1, le=10_000, description="most jobs of one grid")
    ping_seconds: float = Field(default=15.0, gt=0, description="silence on an event stream before a comment is sent")
    poll_seconds: float = Field(default=0.4, gt=0, description="seconds between two looks of a stream at the store")

    render_seconds: float = Field(default=120.0, gt=0, description="time that a drawing may take, its queue included")
    render_idle_seconds: float = Field(default=600.0, gt=0, description="rest after which the render process ends")
    render_socket: Path | None = Field(
        default=None, description="unix socket of `python -m services.renderer PATH`; none = the API starts its own"
    )
    drawings_mb: int = Field(default=512, ge=16, description="disk for finished drawings and exports")

    worker_concurrency: int = Field(default=1, ge=1, le=64, description="jobs that one worker trains at a time")
    threads_per_job: int = Field(default=0, ge=0, description="threads of one job; 0 = cores / worker_concurrency")
    memory_limit_mb: int = Field(default=0, ge=0, description="data segment of a job's process; 0 = unlimited")
    max_queued_per_owner: int = Field(default=10_000, ge=0, description="jobs of one owner that may wait; 0 = any")
    max_running_per_owner: int = Field(default=0, ge=0, description="jobs of one owner that may run at once; 0 = any")
    max_attempts: int = Field(default=3, ge=1, description="infrastructure failures that a job survives, plus one")
    lease_seconds: float = Field(default=60.0, gt=0, description="silence after which a worker's job is given away")
    heartbeat_seconds: float = Field(default=1.0, gt=0, description="seconds between two writes of a running job")
    stall_seconds: float = Field(default=900.0, gt=0, description="time without progress after which a job is killed")
    grace_seconds: float = Field(default=30.0, ge=0, description="seconds between asking a job to stop and killing it")
    backoff_seconds: float = Field(default=2.0, ge=0, description="wait before the first retry; doubles each time")
    outage_seconds: float = Field(
        default=300.0, ge=0, description="time for which a finished job's result is offered to an absent database"
    )
    sweep_seconds: float = Field(default=5.0, gt=0, description="seconds between two rounds of the sweeper")
    unclaimed_seconds: float = Field(
        default=10.0, ge=0, description="age at which a waiting job's wake-up counts as lost"
    )
    gc_hours: float = Field(default=1.0, ge=0, description="hours between two collections of unnamed bytes; 0 = never")
    gc_grace_seconds: float = Field(default=3600.0, ge=0, description="age before which unnamed bytes are left alone")
    child_command: tuple[str, ...] = Field(
        default=(sys.executable, "-m", "services.worker.child"),
        description="the process that trains",
    )

    @field_validator("home")
    @classmethod
    def _absolute(cls, home: Path) -> Path:
        return home.expanduser().absolute()

    @field_validator("subject_roots", mode="before")
    @classmethod
    def _split_paths(cls, value: Any) -> Any:
        return tuple(p for p in value.split(os.pathsep) if p) if isinstance(value, str) else value

    @field_validator("allowed_hosts", mode="before")
    @classmethod
    def _split_names(cls, value: Any) -> Any:
        return tuple(n.strip() for n in value.split(",") if n.strip()) if isinstance(value, str) else value

    @property
    def embedded_database(self) -> bool:
        """Whether the database is the SQLite file in the home, which migrates itself."""
        return not self.database_url

    @property
    def embedded_broker(self) -> bool:
        """Whether the broker is a private server that ``services.up`` starts."""
        return not self.broker_url

    @property
    def database(self) -> str:
        """SQLAlchemy URL of the database."""
        return self.database_url or f"sqlite:///{self.home / 'rsavatar.db'}"

    @property
    def socket(self) -> Path:
        """Unix socket of the private broker; outside of a home whose path is too long for a socket."""
        inside = self.home / "run" / "redis.sock"
        if len(os.fsencode(inside)) <= LONGEST_SOCKET_PATH:
            return inside
        digest = hashlib.sha256(os.fsencode(self.home)).hexdigest()[:12]
        return Path(tempfile.gettempdir()) / f"rsavatar-{os.getuid()}-{digest}" / "redis.sock"

    @property
    def broker(self) -> str:
        """Kombu URL of the broker."""
        return self.broker_url or f"redis+socket://{self.socket}?virtual_host=0"

    @property
    def threads(self) -> int:
        """Threads of one job."""
        return self.threads_per_job or max(1, (os.cpu_count() or 1) // self.worker_concurrency)

    @property
    def needs_token(self) -> bool:
        """Whether nobody is let in without a token: wherever others than this machine's user could ask."""
        return self.require_token or self.host not in LOOPBACK or bool(self.allowed_hosts)

    @property
    def url(self) -> str:
        """Where a browser on this machine finds the API."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{host}:{self.port}"

    def job_dir(self, job_id: str) -> Path:
        """Folder of one job: checkpoint, outputs and log; the same for every attempt."""
        return self.home / "jobs" / job_id


def read_settings() -> Settings:
    """Read the environment.

    Raises:
        SettingsError: naming the variable, what was expected and what was got.
    """
    try:
        return Settings(**from_files())
    except ValidationError as error:
        first = error.errors()[0]
        name = "RSAVATAR_" + str(first["loc"][0]).upper()
        raise SettingsError(name, first["msg"].lower(), repr(first["input"])) from None


def without_secrets(environment: Mapping[str, str]) -> dict[str, str]:
    """What processes get that compute or draw: not the addresses of the stores, nor keys to a bucket."""
    withheld = {f"RSAVATAR_{name}{suffix}" for name in SECRETS for suffix in ("", "_FILE")}
    return {k: v for k, v in environment.items() if k not in withheld and not k.startswith("AWS_")}


def from_files() -> dict[str, Any]:
    """Settings whose value is a file's first line: ``RSAVATAR_X_FILE`` gives ``x``. Secrets are in no environment then.

    Raises:
        SettingsError: if the file cannot be read, or ``RSAVATAR_X`` is given as well.
    """
    found: dict[str, Any] = {}
    for name in Settings.model_fields:
        variable = f"RSAVATAR_{name.upper()}"
        path = os.environ.get(f"{variable}_FILE")
        if path is None:
            continue
        if variable in os.environ:
            raise SettingsError(variable, f"nothing, because {variable}_FILE is given", "a value")
        try:
            found[name] = Path(path).read_text("utf-8").partition("\n")[0].strip()
        except OSError as error:
            raise SettingsError(f"{variable}_FILE", "a readable file", f"{path} ({error.strerror})") from None
    return found


def make_home(settings: Settings) -> None:
    """Create the home and its folders, readable by their owner alone."""
    inside = (settings.home / name for name in ("run", "jobs", "artifacts", "logs", "uploads", "subjects"))
    for folder in (settings.home, *inside, settings.socket.parent):
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
