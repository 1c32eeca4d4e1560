"""Who may do what in a run's Redis: a user for every role, with the commands and keys that the role needs.

R stands for ``rmc:{run}``, as in ``common/bus/protocol.py``. A rule in parentheses is a selector: its commands on its
keys alone, which takes Redis 7 or Valkey.
OWN stands for the actors whose streams a replay server reads.
The user ``default`` is off. Passwords follow from the run's secret, one for each user, and give nothing else away;
the server is told their hashes.
"""

import hashlib
import hmac
import string
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import product

from rmc.common.bus.redis_bus import ACTOR_DIGITS
from rmc.common.shard import Shard

LAUNCHER = "launcher"
CONNECTS = "+ping +hello"
EVERYONE = ("(+get %R~R:config %R~R:stop)", "(+get +set +incr +incrby ~R:epoch:ROLE)", "(+xadd %W~R:metrics:ROLE)")
ACTOR = (
    "(+get %R~R:weights %R~R:weights:*)",
    "(+sadd %W~R:actors)",
    "(+xadd %W~R:windows:INDEX)",
    "(+xinfo|stream %R~R:windows:INDEX)",
    "(+hget %R~R:acks)",
)
EVALUATOR = ("(+get %R~R:evaluate %R~R:evaluate:*)",)
LEARNER = (
    "+watch +unwatch +multi +exec",
    "(+get +set ~R:weights ~R:evaluate)",
    "(+set +expire +exists +persist ~R:weights:* ~R:evaluate:*)",
    "(+watch ~R:epoch:ROLE)",
    "(+hget %R~R:replay)",
)
REPLAY = (
    "+watch +unwatch +multi +exec",
    "(+get %R~R:weights %R~R:epoch:learner %R~R:epoch:actor-*)",
    "(+smembers %R~R:actors)",
    "(+xread +xtrim ~R:windows:OWN)",
    "(+watch ~R:epoch:ROLE)",
    "(+hset ~R:acks)",
    "(+hget +hset +hsetnx ~R:progress)",
    "(+hset %W~R:replay)",
    "(+xadd %W~R:dead)",
    "(+eval +get +xtrim +del ~R:epoch:ROLE ~R:windows:OWN)",  # a full Redis takes these by a script alone
)
PLAIN = frozenset(string.ascii_letters + string.digits + "._-:")
OWNER = ("~R:*", "+@all -@dangerous -@admin -@scripting -@pubsub +acl|load")


@dataclass(frozen=True)
class RedisUsers:
    """The users of one run: ``launcher``, and the roles by their names."""

    run: str
    secret: bytes = field(repr=False)
    roles: tuple[str, ...]

    def password(self, user: str) -> str:
        """A user's password; it does not give the secret away."""
        return hmac.new(self.secret, b"redis " + user.encode(), hashlib.sha256).hexdigest()

    def login(self, user: str) -> str:
        """The part of a URL that says who connects."""
        return f"{user}:{self.password(user)}@"

    def acl(self) -> str:
        """The server's ACL file."""
        users = [self._user(LAUNCHER, OWNER), *(self._user(role, _rules(role)) for role in self.roles)]
        return "\n".join(["user default off sanitize-payload", *users]) + "\n"

    def _user(self, name: str, rules: Iterable[str]) -> str:
        hashed = hashlib.sha256(self.password(name).encode()).hexdigest()
        text = f"user {name} on sanitize-payload resetchannels #{hashed} {CONNECTS} {' '.join(rules)}"
        text = text.replace(":ROLE", f":{name}").replace(":INDEX", f":{name.rpartition('-')[2]}")
        streams = " ".join(f"~R:windows:{actor}" for actor in self._own_actors(name))
        return text.replace("~R:windows:OWN", streams).replace("~R:", f"~rmc:{_pattern(self.run)}:")

    def _own_actors(self, role: str) -> list[str]:
        shards = sum(name.startswith("replay") for name in self.roles)
        return actor_patterns(Shard(int(role.rpartition("-")[2]), shards)) if role.startswith("replay-") else ["*"]


def _pattern(run: str) -> str:
    """A run's name in a key pattern: what an ACL file cannot hold, or a pattern takes for more, is any one byte."""
    return "".join(chr(byte) if chr(byte) in PLAIN else "?" for byte in run.encode())


def actor_patterns(shard: Shard) -> list[str]:
    """Patterns that match the ids of a shard's actors alone: digits stand together that leave the same rest."""
    patterns = []
    for length in range(1, ACTOR_DIGITS + 1):
        places = [_digits_by_rest(10**power, shard.count) for power in reversed(range(length))]
        for digits in product(*(place.items() for place in places)):
            if sum(rest for rest, _ in digits) % shard.count == shard.index:
                patterns.append("".join(f"[{same}]" for _, same in digits))
    return patterns


def _digits_by_rest(place: int, divisor: int) -> dict[int, str]:
    digits: dict[int, str] = {}
    for digit in range(10):
        rest = digit * place % divisor
        digits[rest] = digits.get(rest, "") + str(digit)
    return digits


def _rules(role: str) -> tuple[str, ...]:
    own = {"actor": ACTOR, "evaluator": EVALUATOR, "learner": LEARNER, "replay": REPLAY}[role.partition("-")[0]]
    return (*EVERYONE, *own)
