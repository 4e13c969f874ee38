"""Where this user's tokens are: the environment, else a file that nobody else reads, one token for each service."""

from __future__ import annotations

import json
import os
from pathlib import Path

from rsavatar.errors import ClientError, expected

TOKEN_VARIABLE = "RSAVATAR_TOKEN"


def file() -> Path:
    """The file of tokens, by the address of their service."""
    base = os.environ.get("XDG_CONFIG_HOME") or "~/.config"
    return Path(base).expanduser() / "rsavatar" / "tokens.json"


def token_for(url: str) -> str | None:
    """The token for the service at ``url``; none if there is none.

    Raises:
        ClientError: if the file is damaged, or others may read it.
    """
    return os.environ.get(TOKEN_VARIABLE) or read().get(url)


def read() -> dict[str, str]:
    """All tokens of the file.

    Raises:
        ClientError: if the file is damaged, or others may read it.
    """
    path = file()
    try:
        with path.open(encoding="utf-8") as opened:
            if os.fstat(opened.fileno()).st_mode & 0o077:
                raise ClientError(expected(str(path), "a file that its owner alone may read (chmod 600)", "another"))
            tokens = json.load(opened)
    except FileNotFoundError:
        return {}
    except ValueError as error:
        raise ClientError(expected(str(path), "JSON", error)) from None
    if not isinstance(tokens, dict) or not all(isinstance(token, str) for token in tokens.values()):
        raise ClientError(expected(str(path), "an object of addresses and tokens", "something else"))
    return tokens


def remember(url: str, token: str | None) -> Path:
    """Keep a token for ``url``, or forget it where none is given; returns the file.

    Raises:
        ClientError: if the file is damaged, or others may read it.
    """
    kept = {**read(), url: token}
    path = file()
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    with os.fdopen(os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w", encoding="utf-8") as opened:
        json.dump({key: value for key, value in sorted(kept.items()) if value is not None}, opened, indent=1)
    draft.replace(path)
    return path
