"""`signals.yaml`: the place of each signal in a log, its unit and sign."""

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from jaxtyping import Float
from pydantic import Field

from mjx_climb.scenario.messages import failure
from tuning.problem.settings import Finite, NonNegative, Positive, Settings, setting

UNITS: dict[str, tuple[str, float]] = {  # the SI unit, and how many of it one of these is
    "rad": ("rad", 1.0), "deg": ("rad", math.pi / 180), "counts": ("rad", 2 * math.pi), "m": ("m", 1.0),
    "mm": ("m", 1e-3), "rad/s": ("rad/s", 1.0), "deg/s": ("rad/s", math.pi / 180), "rpm": ("rad/s", math.pi / 30),
    "counts/s": ("rad/s", 2 * math.pi), "m/s": ("m/s", 1.0), "mm/s": ("m/s", 1e-3), "N m": ("N m", 1.0),
    "mN m": ("N m", 1e-3), "kgf cm": ("N m", 0.0980665), "A": ("N m", 1.0), "mA": ("N m", 1e-3), "N": ("N", 1.0),
    "mN": ("N", 1e-3), "kgf": ("N", 9.80665), "N m/rad": ("N m/rad", 1.0), "1": ("1", 1.0),
}  # fmt: skip
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}

if TYPE_CHECKING:
    Unit = str
else:
    Unit = Literal[tuple(UNITS)]
TimeUnit = Literal["s", "ms", "us", "ns"]


class _OfOneOrAll(Settings):
    """What a file says of one signal, or of all that do not say it themselves."""

    bits: int | None = setting(
        None,
        "bits of numbers that were read without their sign, 1: of 16 bits 65527 is -9; null: read with it",
        ge=2,
        le=64,
    )
    sign_bit: int | None = setting(
        None, "bit that makes the number in the bits below it negative, 1: of 10, 1033 is -9; null: none", ge=1, le=63
    )
    rate: Positive | None = setting(None, "samples per second that were recorded, Hz; null: found")

    def faults(self) -> Iterator[ValueError]:
        if self.bits is not None and self.sign_bit is not None:
            yield failure("bits or sign_bit, one of the two", got=f"bits {self.bits}, sign_bit {self.sign_bit}")


class Source(_OfOneOrAll):
    """Where one signal stands, and how its numbers become SI: sign * (number - zero) * unit."""

    topic: str | None = setting(None, "topic of a bag")
    field: str = setting("data", "path in the message, with dots; an entry of a list by its name or its number")
    column: str | None = setting(None, "column of a table; of a cell with a list: name.0, name.1 ...")
    unit: Unit | None = setting(None, "unit of the numbers; null: SI")
    sign: Literal[1, -1] = setting(1, "-1: the axis is the other way round")
    zero: Finite = setting(0.0, "number at zero, in the unit")
    counts_per_turn: Positive | None = setting(None, "encoder counts of one turn, 1")
    torque_constant: Positive | None = setting(None, "torque at the joint of one ampere, N m/A")
    time: str | None = setting(None, "column of its times; header or log of a topic; null: the file's")
    time_unit: TimeUnit | None = setting(None, "unit of its times; null: the file's")
    shift: Finite = setting(0.0, "added to its times, s: where its clock is late, a negative number")

    def faults(self) -> Iterator[ValueError]:
        yield from super().faults()
        if (self.topic is None) == (self.column is None):
            yield failure("a topic or a column, one of the two", got=f"topic {self.topic}, column {self.column}")
        for units, key in (("counts counts/s", "counts_per_turn"), ("A mA", "torque_constant")):
            if self.unit in units.split(" ") and getattr(self, key) is None:
                yield failure(f"{key} with the unit {self.unit}", got=None)

    def completed(self, of_all: Mapping[str, object]) -> "Source":
        """Return where a signal stands, with the keys given for all that it does not have itself."""
        own = {name for name in of_all if getattr(self, name) is not None}
        if self.bits is not None or self.sign_bit is not None:
            own |= {"bits", "sign_bit"}
        return self.changed({name: value for name, value in of_all.items() if name not in own})

    def signed(self, numbers: Float[np.ndarray, " samples"]) -> Float[np.ndarray, " samples"]:
        """Return the recorded numbers with their signs."""
        if self.bits is not None:
            return np.where(numbers >= 2.0 ** (self.bits - 1), numbers - 2.0**self.bits, numbers)
        if self.sign_bit is not None:
            return np.where(numbers >= 2.0**self.sign_bit, 2.0**self.sign_bit - numbers, numbers)
        return numbers

    @property
    def factor(self) -> float:
        """How many SI units one of its numbers is."""
        factor = UNITS[self.unit][1] if self.unit else 1.0
        turns = self.counts_per_turn if self.unit in ("counts", "counts/s") else None
        current = self.torque_constant if self.unit in ("A", "mA") else None
        return self.sign * factor / (turns or 1.0) * (current or 1.0)


class Signals(_OfOneOrAll):
    """Where the signals of a log stand, in which units and on which clocks. Immutable."""

    time: str = setting("header", "column of the times; of topics header, the stamp where there is one, or log")
    time_unit: TimeUnit = setting("s", "unit of the times in columns")
    unit: Literal["rad", "deg"] = setting("rad", "unit of joint angles, and of their rates, that name none")
    repeats: Literal["drop", "keep"] = setting(
        "drop", "what is done with measured samples that repeat the one before to the last bit, all of one message"
    )
    turns: Literal["unwrap", "keep"] = setting(
        "unwrap", "what is done with joint angles that jump by whole turns between neighbours"
    )
    outliers: Literal["suspect", "drop", "keep"] = setting(
        "suspect", "what is done with samples of 0, or others, that jump away from those beside them and back"
    )
    longest_gap: Annotated[NonNegative, Field(gt=1)] = setting(
        5.0, "spacing that is called a gap, in usual spacings, 1"
    )
    signals: dict[str, Source] = setting({}, "where each signal stands, by its name")

    @property
    def of_all(self) -> dict[str, object]:
        """The keys of a signal that are given once for all."""
        return self.model_dump(include=set(_OfOneOrAll.model_fields), exclude_none=True)

    def to_yaml(self) -> str:
        """The settings as YAML without defaults, a line a signal; loading it gives equal ones."""
        import yaml

        data: dict[str, Any] = self.model_dump(mode="json", exclude_defaults=True)
        rows = data.pop("signals", {})
        head = yaml.safe_dump({"time": self.time, **data}, sort_keys=False)
        lines = [
            f"  {name}: {yaml.safe_dump(source, default_flow_style=True, sort_keys=False, width=10_000).strip()}\n"
            for name, source in rows.items()
        ]
        return head + "signals:\n" + "".join(lines)
