"""Malformed input for the program, made from what is valid: files and lists of arguments, each by its number alone."""

import random
from pathlib import Path
from typing import NamedTuple

CONFIGS = Path(__file__).parents[1] / "configs"
CASES = {name: (CONFIGS / f"{name}.yaml").read_text() for name in ("case_1_1", "case_1_2", "case_2")}
CASES["slope"] = """\
gravity: [0.3, -0.2, -1.6]
duration: 2.0
gait: {cycle: 1.0, heading: 0.3, base_reference: actual}
ground: {footholds: {LF: [0.0, 0.004, 0.002], LH: [0.0, -0.003], RH: [0.001], RF: [0.0]}}
control: {controller: end_effector_admittance, inertia: 1, damping: [1, 2, 3, 4, 5, 6], stiffness: 300}
disturbance: {cargo: {mass: 0.2, start: 0.1, stop: 1.0}, pushes: [{force: [1, 0, 0], moment: [0, 1, 0], start: 0}]}
"""
GAINS = """\
# written by tune
inertia: 1.0
damping: [90.0, 120.0, 33.0, 2.0, 5.0, 1.5]
stiffness: [3000.0, 2000.0, 1000.0, 7.5, 30.0, 11.0]
kp: 45.0
kd: 0.2
"""
SEARCH = """\
method: cmaes
space: split
inertia: true
joint_gains: true
bounds: {damping: [10.0, 1.0e4], stiffness.rotation: [1.0, 1.0e3]}
pins: {damping.rotation: 50.0}
weights: {force_variation: 1.0, cost_of_transport: 0.5}
limits: {base_deviation: 0.01, joint_limit_margin: 0.1}
deviation_factor: 2.0
no_worse_than_pd: false
starts: 4
iterations: 2
seed: 3
precision: float64
"""
LOG = "time,LF.coxa.command,LF.coxa.position,LH.force.z,comment,packed\n" + "".join(
    f'{n / 100},{n / 1000},{n / 1000 - 0.01},{"" if n % 2 else n / 7},word,"[{n}, 1.0]"\n' for n in range(30)
)
SIGNALS = """\
time: time
time_unit: s
repeats: keep
longest_gap: 4.0
signals:
  LF.coxa.command: {column: LF.coxa.command, unit: deg, sign: -1}
  LF.coxa.position: {column: LF.coxa.position, unit: counts, counts_per_turn: 4096, zero: 2048, shift: 0.01}
  LF.femur.command: {column: packed.0, unit: deg, rate: 100.0}
  LH.force.z: {column: LH.force.z, unit: kgf, time: time, time_unit: ms}
"""
ENSEMBLE = (CONFIGS / "ensemble.yaml").read_text()

RANGES = ["--stiffness", "1e3:1e5:3", "--damping", "1e2:1e3:2"]
COMMANDS = {  # the command and what it does, with every option that takes a value, {config} and so on for files
    "run": "{config} --controller pd --set control.damping=2e3 --gains {gains} --engine mjx --compare base_admittance "
    "--snapshots --at 0.5,1 --size 640x480 --json",
    "sweep": "{config} --stiffness 1e3:1e5:3 --damping 1e2:1e3:2 --gains {gains} --batch-size 4 --shard 2/3 "
    "--set control.kd=0.1",
    "replay": "{config} --log {log} --signals {signals} --base held --with-law --size 640x480 --set control.kd=0.1",
    "sweep, merged": "--merge taken",
    "plot": "taken --metric min_tsm --figures png,pdf --figure-size 60x60 --dpi 100 --style ggplot",
    "robot": "taken --gravity 1.6 --base base --limbs a,b",
    "tune": "{config} --method grid --space split --starts 3 --iterations 2 --seed 1 --weight force_variation=1 "
    "--limit base_deviation=0.01 --bound damping=1:10 --pin stiffness.rotation=3 --search {search} --gains {gains}",
    "tune, a front": "{config} --better force_variation --against base_deviation --points 3 --space split "
    "--search {search}",
    "tune, points": "{config} --over gravity=1e-6,1/6,1 --over cargo=0,0.5 --space split --search {search}",
    "evaluate, margins": "{config} --margins --gains {gains} --retuned-pd {gains} --controller pd --hardware ideal "
    "--set control.kd=0.1",
    "evaluate, worse": "{config} --gains {gains} --worse force_sensor.noise=0.5 --ensemble {ensemble} --members 8",
    "evaluate": "{config} --gains {gains} --ensemble {ensemble} --members 8 --controller base_admittance --shard 1/2 "
    "--set control.kd=0.1",
    "tune, laws": "{config} --law base_admittance --law end_effector_admittance --ensemble {ensemble} --members 8 "
    "--test-members 8 --starts 4 --iterations 2 --also inertia --pin damping=30 --bound kp=10:90 --search {search}",
    "excite": "{config} --duration 2 --candidates 1 --fit hardware.servo.armature --family chirp --kp 30 --margin 0.5 "
    "--rate 50 --noise 1e-3 --base held --mass 0.1 --low 0.2 --high 5 --seed 1 --set control.kd=0.1",
    "identify": "{config} --log {log} --fit hardware.servo.armature --signals {signals} --held-out 0.2 --starts 2 "
    "--set control.kd=0.1 --json",
    "export": "{gains} --format ros2_control --update-rate 500 --name admittance",
    "doctor, schema": "--schema",
    "doctor, speed": "--bench --batch 64 --quick",
    "runs": "taken --json",
    "reproduce": "--json",
    "doctor": "--json",
}
FRONT, POINTS = "tune --against base_deviation", "tune --over gravity,cargo"
USES = {
    "config": ("run", "sweep", "tune", FRONT, POINTS, "evaluate --margins", "excite"),
    "gains": ("run", "sweep", "tune", "evaluate --margins", "export"),
    "search": ("tune", FRONT, POINTS),
    "ensemble": ("tune",),
    "log": ("replay", "identify"),
    "signals": ("replay", "identify"),
}
ENDINGS = {"log": "csv"}  # of others yaml
NUMBERS = (
    "nan", ".nan", ".inf", "-.inf", "inf", "1e999", "-1e999", "1e308", "-1e308", "1e-320", "0", "-0.0", "-1", "1e300",
    "9" * 400, "0x10", "1_000", "1,5", "0.1e", "--1", "1e-30", "1e18", "3.5", "\u0661\u0662", "1:2", "1/0", "1e400/3",
)  # fmt: skip
VALUES = (
    *NUMBERS, "", "~", "null", "true", "yes", "[]", "{}", "[1]", "[1, 2, 3]", "[[1, 2], 3]", "{a: 1}", "'8'", "\"\\0\"",
    "2026-01-01", "!!python/name:os.system", "!!binary aGk=", "*a", "&a 1", "? 1", "- 1", "|", "'", "[", "}", "%", "@",
    "\u2028", "caf\u00e9", "\U0001f916", "a" * 3000,
)  # fmt: skip
WORDS = (
    *VALUES, "-", "--", "-h=", "--frobnicate", "--set", "--out", "--json=1", "x=y", "=", "a.b=1", "control.damping",
    "control.damping=", "gravity.9=1", "robot=spot", "robot.file=/dev/null", "ground.map={file: x.csv, resolution: 1}",
    "disturbance.pushes.0.start=1", "gait={}", "1:0:5", "1:2:1", "1:2", "1:2:3:4", "nan:1:3", "1:inf:3", "0:1:3", "::",
    "1:2:1e9", "1e3:1e2:4", "-1:1:3", "1:1.0000000001:9", "1:2:\u0663", "640x", "0x0", "99999x2", "641x480",
    "damping=1:2:3", "damping=x", "damping=nan:1", "stiffness.q=1", "nothing=1", "base_deviation=inf", "diverged=1",
    "0/3", "4/3", "1/1/1",
    "a\nb", "a\tb", "a\x1b[31mb", "\udc80", "a\0b", "/", ".", "..", "/dev/null", "/proc/nowhere/x", "b" * 300,
)  # fmt: skip


FOLDERS = ("{folder}/taken", "{folder}/taken/below", "/dev/null", "/dev/null/x", "/proc/nowhere", "", "{long}")
KEYS = ("frobnicate: 1", "a: &a [x]\nb: *a", "<<: {duration: 1}", "1: 2", "? [a]\n: b")


class Case(NamedTuple):
    """One malformed call."""

    arguments: list[str]  # {folder} stands for the folder of the files
    files: dict[str, bytes | None]  # by name; None: a folder


def case(number: int) -> Case:
    """Return the malformed call of a number."""
    rng = random.Random(number)
    files: dict[str, bytes | None] = {
        "config.yaml": rng.choice(list(CASES.values())).encode(),
        "gains.yaml": GAINS.encode(),
        "search.yaml": SEARCH.encode(),
        "ensemble.yaml": ENSEMBLE.encode(),
        "log.csv": LOG.encode(),
        "signals.yaml": SIGNALS.encode(),
        "taken": b"a file",
    }
    if rng.random() < 0.6:
        kind = rng.choice(["config", "config", "config", "gains", "search", "ensemble", "log", "signals"])
        name = f"{kind}.{ENDINGS.get(kind, 'yaml')}"
        files[name] = _damaged(rng, files[name])
        if rng.random() < 0.04:
            files[name] = None
        elif rng.random() < 0.03:
            del files[name]
        return Case(_call(rng.choice(USES[kind]), kind), files)
    return Case(_muddled(rng), files)


def _call(command: str, kind: str) -> list[str]:
    """Return a valid call of a command on a file of this kind."""
    if command == "export":
        return ["export", "{folder}/gains.yaml"]
    other = [] if kind == "config" else [f"--{kind}", f"{{folder}}/{kind}.{ENDINGS.get(kind, 'yaml')}"]
    other += ["--log", "{folder}/log.csv"] if kind == "signals" else []
    name, *asked = command.split()
    return [name, "{folder}/config.yaml", *asked, *other, *(RANGES if command == "sweep" else ())]


def _muddled(rng: random.Random) -> list[str]:
    """Return a list of arguments that is most likely wrong."""
    kind = rng.choice(list(COMMANDS))
    command, words = kind.partition(",")[0], COMMANDS[kind]
    for kind in USES:
        words = words.replace(f"{{{kind}}}", f"{{folder}}/{kind}.{ENDINGS.get(kind, 'yaml')}")
    words = words.split()
    if command not in ("doctor", "robot"):
        words += ["--out", "{folder}/out"]
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        at = rng.randrange(len(words)) if words else 0
        match rng.randrange(8):
            case 0 if words:
                del words[at]
            case 1 if words:
                words.insert(at, words[at])
            case 2:
                words.insert(at, rng.choice(WORDS))
            case 3 if words:
                other = rng.randrange(len(words))
                words[at], words[other] = words[other], words[at]
            case 4 if words:
                option, equals, _ = words[at].partition("=")
                cut = words[at][: rng.randrange(len(words[at]) + 1)]
                words[at] = f"{option}={rng.choice(VALUES)}" if equals else cut
            case 5 if "--out" in words[:-1]:
                words[words.index("--out") + 1] = rng.choice(FOLDERS).replace("{long}", "c" * 300)
            case _ if words:
                words[at] = rng.choice(WORDS)
    return [command, *words]


def _damaged(rng: random.Random, content: bytes) -> bytes:
    """Return the content of a file with something done to it."""
    lines = content.decode().splitlines()
    at = rng.randrange(len(lines))
    match rng.randrange(14):
        case 0:
            flipped = bytearray(content)
            for _ in range(rng.choice((1, 1, 3, 20))):
                flipped[rng.randrange(len(flipped))] ^= 1 << rng.randrange(8)
            return bytes(flipped)
        case 1:
            return content[: rng.randrange(len(content))]
        case 2:
            start = rng.randrange(len(content))
            return content[:start] + content[start + rng.randrange(30) :]
        case 3:
            start = rng.randrange(len(content))
            return content[:start] + rng.randbytes(rng.randrange(1, 9)) + content[start:]
        case 4:
            lines.insert(at, lines[rng.randrange(len(lines))])
        case 5:
            lines[at] = rng.choice((" ", "\t", "   ")) + lines[at]
        case 6:
            key, colon, _ = lines[at].partition(":")
            lines[at] = key[::-1] + colon + " 1"
        case 7:
            lines.insert(at, rng.choice(KEYS))
        case 8:
            bomb = ["a0: &a0 [x, x]", *(f"a{n}: &a{n} [*a{n - 1}, *a{n - 1}, *a{n - 1}]" for n in range(1, 40))]
            lines = [*bomb, *lines]
        case 9:
            opening = rng.choice(("[", "{a: ", "- ", "? "))
            lines.insert(at, f"deep: {opening * rng.choice((30, 3000, 60_000))}")
        case 10:
            return rng.choice((b"", b"\n", b"\0", b"---\n---\n", b"\xff\xfe", content.decode().encode("utf-16"),
                               b"[" * 9, b"x" * 1_100_000, b"a: 1\n" * 30_000, rng.randbytes(500)))  # fmt: skip
        case _:
            key, colon, _ = lines[at].partition(":")
            lines[at] = f"{key}{colon} {rng.choice(VALUES)}" if colon else rng.choice(VALUES)
    return "\n".join(lines).encode("utf-8", "surrogatepass") + b"\n"
