"""Tokens: issue, list, revoke; and who one is."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated

from fastapi import APIRouter, Path, Response
from pydantic import BaseModel, ConfigDict, Field

from services.api.access import ADMIN, Who
from services.api.deps import UUID, Back
from services.api.views import instant
from services.store import tokens
from services.store.tokens import DAY, Scope, Token

NAME = r"^[A-Za-z0-9][A-Za-z0-9 ._@+-]*$"  # no colon: names of sessions have one
LONGEST_DAYS = 3650

router = APIRouter(prefix="/tokens", tags=["tokens"])
TokenId = Annotated[str, Path(pattern=UUID, description="id of a token")]


class TokenRequest(BaseModel):
    """A token to be."""

    model_config = ConfigDict(extra="forbid")

    name: str = Field(min_length=1, max_length=100, pattern=NAME, description="what it is for")
    owner: str = Field(min_length=1, max_length=64, pattern=NAME, description="whose jobs it makes")
    scopes: list[Scope] = Field(min_length=1, max_length=3)
    days: float | None = Field(90.0, gt=0, le=LONGEST_DAYS, description="until it expires; null = never")


class TokenView(BaseModel):
    """A token without its secret."""

    id: str
    name: str
    owner: str
    prefix: str
    scopes: list[str]
    created_at: datetime | None
    expires_at: datetime | None
    revoked_at: datetime | None
    last_used_at: datetime | None

    @classmethod
    def of(cls, token: Token) -> TokenView:
        """The view of a token."""
        return cls(**cls.fields_of(token))

    @classmethod
    def fields_of(cls, token: Token) -> dict[str, object]:
        """Values of the fields that every view of a token has."""
        instants = {key: instant(value) for key, value in vars(token).items() if key.endswith("_at")}
        return {**vars(token), "scopes": list(token.scopes), **instants}


class IssuedView(TokenView):
    """A new token. The secret is shown this once."""

    secret: str


class CallerView(BaseModel):
    """Who the service takes the caller for."""

    owner: str
    scopes: list[str]
    token_id: str | None


@router.get("/me")
def whoami(who: Who) -> CallerView:
    """Owner and scopes of the token that came with the request."""
    return CallerView(owner=who.owner, scopes=sorted(who.scopes), token_id=who.token_id)


@router.get("", dependencies=[ADMIN])
def list_tokens(back: Back) -> list[TokenView]:
    """All tokens, newest first, revoked ones too."""
    return [TokenView.of(token) for token in tokens.all_of(back.store)]


@router.post("", status_code=201, dependencies=[ADMIN])
def issue(body: TokenRequest, response: Response, back: Back) -> IssuedView:
    """A new token."""
    lifetime = None if body.days is None else body.days * DAY
    token, secret = tokens.issue(back.store, body.name, body.owner, body.scopes, lifetime)
    response.headers["location"] = f"/api/v1/tokens/{token.id}"
    return IssuedView(**TokenView.fields_of(token), secret=secret)


@router.delete("/{token_id}", dependencies=[ADMIN])
def revoke(token_id: TokenId, back: Back) -> TokenView:
    """End a token, and the sessions that it opened, at once."""
    return TokenView.of(tokens.revoke(back.store, token_id))
