"""Who may do what at a bridge, by the names in certificates, as zenoh's access control has it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass

_ALL = "skinware/**"
_OF_A_ROBOT = "skinware/*/*/*"
_QUESTIONS = [f"{_OF_A_ROBOT}/{what}" for what in ("services", "*/generation", "*/newest")]
_PINGS = [f"{_OF_A_ROBOT}/ping"]
_CALLS = [f"{_OF_A_ROBOT}/*/call/**"]

_LISTENING = ["declare_subscriber", "liveliness_query", "declare_liveliness_subscriber"]
_SPEAKING = ["put", "declare_subscriber", "delete", "reply", "declare_queryable", "liveliness_token"]
_ASKING = ["query"]


@dataclass(frozen=True)
class Rules:
    """What others may do at one that serves a robot, or routes: they see and ask; and what is told here.

    Attributes:
        callers: who may call operations; empty: all who are let in.
        routes: it speaks for no robot, but passes on what robots and their users say.
        robots: of a router: each may serve the robot of its own name, and nobody else any; empty: all may serve any.
        routers: of a router: other routers, which pass on what their own people do.
    """

    callers: Sequence[str] = ()
    routes: bool = False
    robots: Sequence[str] = ()
    routers: Sequence[str] = ()

    @property
    def names_people(self) -> bool:
        """Whether anybody is named."""
        return bool(self.callers or self.robots or self.routers)

    def text(self) -> str:
        """As zenoh has them."""
        granted = [
            _Grant("see", _LISTENING, [_ALL]),
            _Grant("ask", _ASKING, _QUESTIONS),
            _Grant("ping", ["put"], _PINGS),
            _Grant("call", _ASKING, _CALLS, self.callers),
            *(self._of_router() if self.routes else [_Grant("tell", _SPEAKING, [_ALL], flow="egress")]),
        ]
        return json.dumps(
            {
                "enabled": True,
                "default_permission": "deny",
                "rules": [grant.rule() for grant in granted],
                "subjects": [grant.subject() for grant in granted],
                "policies": [{"rules": [grant.name], "subjects": [grant.name]} for grant in granted],
            }
        )

    def _of_router(self) -> list[_Grant]:
        granted = [_Grant("pass on", [*_LISTENING, *_SPEAKING, *_ASKING], [_ALL], flow="egress")]
        for robot in self.robots:
            keys = [f"skinware/*/{robot}/**", f"skinware/live/{robot}/**"]
            granted.append(_Grant(f"serve {robot}", _SPEAKING, keys, [robot]))
        if not self.robots:
            granted.append(_Grant("serve", _SPEAKING, [_ALL]))
        if self.routers:
            granted.append(_Grant("route", [*_SPEAKING, *_ASKING], [_ALL], self.routers))
        return granted


@dataclass(frozen=True)
class _Grant:
    """Something that is allowed; what nobody allows is denied.

    Attributes:
        name: of it.
        messages: of zenoh, that may pass.
        keys: under which.
        to: names in certificates; empty: all.
        flow: ``ingress`` or ``egress``.
    """

    name: str
    messages: Sequence[str]
    keys: Sequence[str]
    to: Sequence[str] = ()
    flow: str = "ingress"

    def rule(self) -> dict[str, object]:
        return {
            "id": self.name,
            "permission": "allow",
            "flows": [self.flow],
            "messages": list(self.messages),
            "key_exprs": list(self.keys),
        }

    def subject(self) -> dict[str, object]:
        return {"id": self.name} | ({"cert_common_names": list(self.to)} if self.to else {})
