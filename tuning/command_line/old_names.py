"""Commands and options of the last version in the words of this one: for one release, then this file goes."""

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

Words = list[str]
_FLAGS = ("--json", "--help")  # of `merge`: options that no value follows


class Old(NamedTuple):
    """What stands for a command of the last version."""

    now: str
    options: Mapping[str, Callable[[str], Words]] = MappingProxyType({})  # words from a value, "" for an argument's
    flags: Mapping[str, str] = MappingProxyType({})


def _laws(text: str) -> Words:
    """Return an option for each law of a list with commas but pd, in which gains may follow a law: Law@damping,kp."""
    laws: Words = []
    for name in filter(None, map(str.strip, text.split(","))):
        shipped = name in ("pd", "base_admittance", "end_effector_admittance")
        gain = bool(laws) and "@" in laws[-1] and ":" not in name and name[0].islower() and not shipped
        laws[-1:] = [f"{laws[-1]},{name}"] if gain else [*laws[-1:], name]
    return [word for law in laws if law != "pd" for word in ("--law", law)]


OLD = {
    "merge": Old("sweep", {"": lambda folder: ["--merge", folder]}),
    "judge": Old("evaluate"),
    "margins": Old("evaluate --margins"),
    "compare": Old("tune --law pd", {"--laws": _laws, "--members": lambda count: ["--test-members", count]}),
    "pareto": Old("tune --against base_deviation"),
    "schedule": Old(
        "tune --over gravity,cargo",
        {"--gravity": lambda text: ["--over", f"gravity={text}"], "--cargo": lambda text: ["--over", f"cargo={text}"]},
    ),
    "bench": Old("doctor --bench"),
    "schema": Old("doctor --schema"),
    "tune": Old("tune", {"--judges": lambda count: ["--test-members", count]}),
    "replay": Old("replay", flags={"--judge": "--with-law"}),
    "run": Old("run", flags={"--ceiling": "--roof"}),
    "robot": Old("robot", flags={"--ceiling": "--roof"}),
    "plot": Old("plot", {"--size": lambda size: ["--figure-size", size]}),
}


def translated(arguments: Sequence[str]) -> Words:
    """Return arguments in the words of this version: the same where they are so."""
    name, *words = arguments or [""]
    if name not in OLD:
        return [*arguments]
    old, found = OLD[name], OLD[name].now.split()
    while words:
        word = words.pop(0)
        option, equals, value = word.partition("=") if word.startswith("--") else ("", "=", word)
        if option in old.options and (equals or words):
            found += old.options[option](value if equals else words.pop(0))
            continue
        found.append(old.flags.get(word, word))
        if "" in old.options and words and not (equals or option in _FLAGS):
            found.append(words.pop(0))
    return found
