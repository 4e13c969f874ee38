"""Verbs about who may do what: login, token, owner."""

from __future__ import annotations

import argparse
import getpass
import sys
from typing import Any

from rsavatar import credentials
from rsavatar.client import Client
from rsavatar.errors import ClientError


def login(arguments: argparse.Namespace) -> int:
    """``rsavatar login``: try a token, and keep it for this service; --forget does the contrary."""
    with Client(arguments.url) as client:
        url = client.url
    if arguments.forget:
        print(f"forgotten in {credentials.remember(url, None)}")
        return 0
    token = (getpass.getpass(f"token for {url}: ") if sys.stdin.isatty() else sys.stdin.readline()).strip()
    if not (token and token.isascii() and token.isprintable()):
        raise ClientError("token: expected one on standard input", "got none")
    with Client(url, token=token) as client:
        me = client.whoami()
    path = credentials.remember(url, token)
    print(f"{me['owner']} ({', '.join(me['scopes'])}) at {url}; kept in {path}")
    return 0


def create(arguments: argparse.Namespace) -> int:
    """``rsavatar token create``: a new token, of which the secret is printed this once."""
    days = None if arguments.days == 0 else arguments.days
    with Client(arguments.url) as client:
        made = client.issue_token(arguments.name, arguments.owner, arguments.scope, days)
    print(
        f"{made['id']}  {made['owner']}  {', '.join(made['scopes'])}  until {made['expires_at'] or 'revoked'}",
        file=sys.stderr,
    )
    print(made["secret"])
    return 0


def show(arguments: argparse.Namespace) -> int:
    """``rsavatar token list``: a line per token, newest first."""
    with Client(arguments.url) as client:
        for token in client.tokens():
            print(_line(token))
    return 0


def revoke(arguments: argparse.Namespace) -> int:
    """``rsavatar token revoke``: end a token at once."""
    with Client(arguments.url) as client:
        token = client.revoke_token(arguments.token_id)
    print(f"{token['id']}  {token['owner']}  revoked {token['revoked_at'][:16]}")
    return 0


def show_owners(arguments: argparse.Namespace) -> int:
    """``rsavatar owner list``: a line per owner, by name."""
    with Client(arguments.url) as client:
        for owner in client.owners():
            print(_owner_line(owner))
    return 0


def put_owner(arguments: argparse.Namespace) -> int:
    """``rsavatar owner set``: limits and share of an owner; what is not named becomes the service's own."""
    with Client(arguments.url) as client:
        print(_owner_line(client.put_owner(arguments.name, arguments.queued, arguments.running, arguments.share)))
    return 0


def _owner_line(owner: dict[str, Any]) -> str:
    limits = {None: "as the service", 0: "no limit"}
    queued, running = (limits.get(owner[key], str(owner[key])) for key in ("max_queued", "max_running"))
    return f"{owner['name']:<16} waiting: {queued:<15} running: {running:<15} share: {owner['share']:g}"


def _line(token: dict[str, Any]) -> str:
    ends = "revoked" if token["revoked_at"] else f"until {(token['expires_at'] or 'revoked')[:10]}"
    used = f"used {(token['last_used_at'] or 'never')[:16]}"
    words = f"{token['id']}  {token['prefix']}  {token['owner']:<16} {','.join(token['scopes']):<8}"
    return f"{words} {ends:<18} {used:<22} {token['name']}"
