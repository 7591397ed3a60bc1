"""Every option of every command changes what the command asks for, prints or writes: what is computed is recorded."""

import contextlib
import dataclasses
import functools
import importlib
import io
import re
import shutil
from collections import defaultdict
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest
import typer

import mjx_climb as mc
from mjx_climb.execution import devices
from mjx_climb.viz.rendering import RenderingError
from tests import approved
from tests.shell import ROOT
from tuning.command_line.options import SearchFile
from tuning.command_line.program import ARGUMENTS, COMMANDS, program
from tuning.gains import gains_file, own_section
from tuning.problem.search import Search

CONFIG, OTHER = (str(ROOT / "configs" / f"{name}.yaml") for name in ("case_1_2", "case_1_1"))
RECORDED = {  # what takes long, draws or writes, by module
    "mjx_climb": "rollout metrics",
    "mjx_climb.inputs.time_step": "largest_time_step",
    "mjx_climb.execution.devices": "begin",
    "mjx_climb.files.dataset": "save to_dataset write_text_atomically",
    "mjx_climb.viz.recording": "save_mcap",
    "mjx_climb.viz.rerun_recording": "library save_rrd",
    "mjx_climb.viz.plots": "over_style plot_comparison plot_feet plot_walk save_figure",
    "mjx_climb.viz.rendering": "save_image save_video snapshots stance view",
    "mjx_climb.viz.rendering.backend": "find require_display",
    "tuning.proposal.propose": "propose",
    "tuning.proposal.stand": "on_stand",
    "tuning.comparisons.first_walks": "heavy_load on_ceiling slow_enough with_joint_gains",
    "tuning.background": "background",
    "tuning.benchmarks.commands": "measure",
    "tuning.benchmarks.measure": "measure",
    "tuning.command_line.logs": "walked_under_law",
    "tuning.command_line.cache": "cache",
    "tuning.command_line.machine": "cache examine",
    "tuning.command_line.run": "show",
    "tuning.command_line.session": "Session.first_result comparison_table print_on",
    "tuning.comparisons.deployment": "check",
    "tuning.comparisons.linear_margins": "find warnings",
    "tuning.comparisons.margins": "find warnings",
    "tuning.comparisons.pushes": "find",
    "tuning.pages.pushes": "files page_of",
    "tuning.identification.plan.excitation": "chosen set_up",
    "tuning.identification.fit.identify": "identify",
    "tuning.identification.fit.report": "table",
    "tuning.identification.readers": "read_log",
    "tuning.identification.model.replay": "prepare simulate",
    "tuning.identification.model.replay_picture": "plot_replay",
    "tuning.comparisons.of_search": "begin load_tests",
    "tuning.comparisons.of_sweep": "begin",
    "tuning.kinds": "write write_found",
    "tuning.identification.plan.output": "limits notes summary table",
    "tuning.results.config_file": "write_config",
    "tuning.pages.redrawn": "figures",
    "tuning.numbers": "ahead_of number to_json",
    "tuning.writing.folder": "fill",
    "tuning.pages.margins": "files margins_table",
    "tuning.pages.runs": "below write",
    "tuning.pages.sweep": "first",
    "tuning.reproduce.results": "as_json as_markdown lines page reproduced tables",
    "tuning.comparisons.compare": "problem_of run",
    "tuning.comparisons.degraded": "Worse.result",
    "tuning.comparisons.judge": "Draw.result",
    "tuning.searches.ceiling": "ceiling",
    "tuning.searches.pareto": "problem_of run",
    "tuning.searches.schedule": "operating_points run",
    "tuning.comparisons.merge": "merged",
    "tuning.searches.shards": "Rows find home",
    "tuning.searches.sweep": "Grid.named Grid.result",
    "tuning.searches.tune": "from_seeds problem_of",
}
TYPED = {  # what is typed for an option by the name of its parameter, unlike its default
    "also": "--also inertia",
    "at": "--snapshots --at 0.5",
    "base": "--base free",
    "batch": "--batch 64",
    "better": "--better peak_foot_force",
    "bounds": "--bound damping=1:1e5",
    "changes": "--set control.kd=0.1",
    "compare": "--compare pd",
    "ceiling": "--ceiling",
    "contact": "--contact {folder}/mine.py:Sticky",
    "controller": "--controller end_effector_admittance",
    "delays": "--delays 0.01",
    "deviation_factor": "--deviation-factor 2",
    "disturbances": "--disturbance link_wrench",
    "dpi": "--dpi 100",
    "drive": "--drive velocity",
    "drop": "--drop",
    "engine": "--engine mjx",
    "ensemble": "--ensemble {folder}/ensemble.yaml",
    "figures": "--figures svg",
    "fit": "--fit control.kp",
    "frozen": "--freeze damping",
    "gains": "--gains {folder}/gains.yaml",
    "hardware": "--hardware dynamixel_x",
    "held_out": "--held-out 0.3",
    "inertia": "--with-inertia",
    "iterations": "--iterations 2",
    "joint_gains": "--with-joint-gains",
    "json_only": "--json",
    "knots": "--knots 0.2",
    "law": "--law LoadTransfer",
    "limits": "--limit base_deviation=0.01",
    "log": "--log other.csv",
    "margin": "--margin contact.damping=x0.5",
    "mass": "--mass 0.1",
    "mcap": "--mcap",
    "members": "--members 3",
    "method": "--method grid",
    "metrics": "--metric {folder}/mine.py:highest",
    "of_scenarios": "--schema",
    "no_worse_than_pd": "--may-be-worse-than-pd",
    "objective": "--objective {folder}/mine.py:calm",
    "out": "--out elsewhere",
    "pins": "--pin damping=30",
    "points": "--points 3",
    "precision": "--precision float64",
    "quick": "--quick",
    "retuned_pd": "--retuned-pd {folder}/gains.yaml",
    "search": "--search {folder}/search.yaml",
    "seed": "--seed 5",
    "sections": "--section {folder}/mine.py:Mine",
    "seeds": "--seeds 2",
    "shard": "--shard 1/2",
    "signals": "--signals signals.yaml",
    "slope": "--slope 30",
    "snapshots": "--snapshots",
    "space": "--space split",
    "starts": "--starts 3",
    "style": "--style ggplot",
    "test_members": "--test-members 5",
    "video": "--video",
    "view": "--view",
    "weights": "--weight force_variation=1",
    "with_tune": "--with-tune",
    "rerun": "--rerun",
    "roof": "--roof",
    "worse": "--worse force_sensor.noise=2",
}  # fmt: skip
ALONE = "{config}"  # of a command or a form that is not in `LINES`: a line that works
LINES = {  # a command, and what asks for another form of it: one that works, the options that its own need beside them
    "replay": "{config} --log log.csv",
    "sweep": "{config} --stiffness 1:2:2 --damping 1:2:2",
    "sweep merge": "--merge folder",
    "tune law law": "{config} --law pd --law base_admittance",
    "tune against": "{config} --against base_deviation",
    "tune over": "{config} --over gravity,cargo",
    "evaluate": "{config} --gains {folder}/held.yaml",
    "evaluate margins": "{config} --margins",
    "evaluate worse": "{config} --gains {folder}/held.yaml --worse force_sensor.noise=0.5",
    "evaluate ceiling": "{config} --ceiling",
    "evaluate pushes": "{config} --pushes",
    "evaluate merge": "--merge folder",
    "plot": "folder",
    "runs": "",
    "reproduce": "",
    "identify": "{config} --log log.csv --fit hardware.command_delay",
    "export": "{folder}/held.yaml --config {config}",
    "robot": "robot.xml",
    "doctor": "",
    "doctor bench": "--bench",
    "doctor of_scenarios": "--schema",
}
OWN = {  # in place of those of `TYPED`, of a command or form
    "run size": ["--snapshots --size 640x480", "--video --size 640x480"],
    "run at": ["--snapshots --at 0.5"],
    "replay size": ["--video --size 640x480"],
    "replay with_law": ["--with-law"],
    "sweep batch_size": ["--batch-size 2"],
    "sweep law": ["--law {folder}/mine.py:Mine"],
    "sweep merge law": ["--law {folder}/mine.py:Mine"],
    "evaluate law": ["{config} --gains {folder}/mine.yaml --law {folder}/mine.py:Mine"],
    "evaluate ceiling ceiling": ["{config} --gains {folder}/held.yaml --ceiling"],
    "evaluate ceiling against": ["--against base_deviation"],
    "evaluate ceiling better": ["--against base_deviation --better peak_foot_force"],
    "evaluate ceiling points": ["--against base_deviation --points 3"],
    "evaluate ceiling members": ["--members 3"],
    "evaluate worse law": [
        "{config} --gains {folder}/mine.yaml --worse force_sensor.bias=1 --law {folder}/mine.py:Mine"
    ],
    "evaluate pushes pushes": ["{config} --gains {folder}/held.yaml --pushes"],
    "evaluate pushes push_length": ["--push-length 0.5"],
    "evaluate pushes largest_push": ["--largest-push 30"],
    "evaluate pushes push_draws": ["--push-draws 9"],
    "evaluate merge law": ["--law {folder}/mine.py:Mine"],
    "evaluate margins margins": ["{config} --gains {folder}/held.yaml --margins"],
    "tune law law method": ["--method grid"],
    "tune members": ["--ensemble ensemble --members 3"],
    "tune test_members": ["--ensemble ensemble --test-members 5"],
    "identify figures": ["--out elsewhere --figures svg"],
    "identify sections": ["--out elsewhere --section {folder}/mine.py:Mine"],
    "plot metric": ["--metric min_tsm"],
    "runs folder": ["{folder}"],
    "plot figure_size": ["--figure-size 60x60"],
    "excite family": ["--family chirp"],
    "excite duration": ["--duration 3"],
    "excite low": ["--low 0.2"],
    "excite high": ["--high 5"],
    "excite kp": ["--kp 30"],
    "excite limb_by_limb": ["--limb-by-limb"],
    "excite rate": ["--rate 50"],
    "excite noise": ["--noise 1e-3"],
    "excite margin": ["--margin 0.5"],
    "excite candidates": ["--candidates 1"],
    "export form": ["--format json"],
    "export rate": ["--format ros2_control --update-rate 500"],
    "export name": ["--format ros2_control --name mine"],
    "robot write": ["--write scenario.yaml"],
    "robot gravity": ["--gravity 1.6"],
    "robot base": ["--base trunk"],
    "robot limbs": ["--limbs a,b"],
    "robot stand": ["--stand"],
    "doctor bench bench": ["--bench"],
}


REFUSED = "refused: "
MEASURED = dict.fromkeys(mc.METRICS.names, 1.0) | {"detached_limb": None, "diverged": False}
PLACED = {  # arguments and required options in place of those of the line
    "config": ("{config}", OTHER),
    "log": ("log.csv", "other.csv"),
    "fit": ("--fit hardware.command_delay", "--fit control.kp"),
    "law": ("--law base_admittance", "--law end_effector_admittance"),
    "against": ("--against base_deviation", "--against peak_foot_force"),
    "over": ("--over gravity,cargo", "--over gravity=1,2"),
    "merge": ("--merge folder", "--merge elsewhere"),
    "folder": ("folder", "elsewhere"),
    "file": ("robot.xml", "other.xml"),
    "stiffness": ("--stiffness 1:2:2", "--stiffness 1:3:2"),
    "damping": ("--damping 1:2:2", "--damping 1:3:2"),
    "axis": ("--damping 1:2:2", "--axis kp=1:2:2"),
    "gains": ("{folder}/held.yaml", "{folder}/gains.yaml"),
}


@dataclasses.dataclass
class Found:
    """A result that is written to nowhere."""

    judges: int | None = None
    interrupted = False
    data = problem = search = knee = MagicMock()


@functools.cache
def command_line(command):
    """Return the program with one command, which takes a while to make."""
    return typer.main.get_command(program(command))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("files")
    gains_file.save(mc.Gains(1.0, 100.0, 1000.0, kp=50.0, kd=0.2), folder / "held.yaml")
    gains_file.save(mc.Gains(2.0, 300.0, 3000.0, kp=60.0, kd=0.3), folder / "gains.yaml")
    (folder / "gait.yaml").write_text("{inertia: 2.0, damping: 300.0, stiffness: 3e3, kp: 60.0, gait: {duty: 0.8}}")
    (folder / "search.yaml").write_text("{space: diagonal, seed: 7}")
    (folder / "ensemble.yaml").write_text(
        (ROOT / "configs" / "ensemble.yaml").read_text().replace("seed: 0", "seed: 7")
    )
    (folder / "mine.py").write_text(
        "from mjx_climb.control import VirtualModelAdmittance\n"
        "from mjx_climb.walk.metrics import largest\n"
        "from mjx_climb.physics.contact.gripper import Gripper\n"
        "class Mine(VirtualModelAdmittance): pass\n"
        "class Sticky(Gripper): pass\n"
        "def calm(metrics): return metrics['travel']\n"
        'highest = largest("highest_base", "m", "highest base", lambda s, _: s.base_position[2])\n'
    )
    sensor = {"hardware.force_sensor.filter": 30.0}
    for name, by in (("filtered", "sensor"), ("by_law", "law")):
        scenario = mc.load_scenario(CONFIG, sensor | {"hardware.force_sensor.filtered_by": by})
        (folder / f"{name}.yaml").write_text(scenario.to_yaml())
    law = mc.control.LoadTransfer()
    gains_file.save({name: getattr(law, name) for name in law.GAINS}, folder / "transfer.yaml", law=law)
    law = own_section.load_law(f"{folder}/mine.py:Mine")
    gains_file.save(mc.Gains(1.0, 100.0, 1000.0), folder / "mine.yaml", law=law)
    return folder


@pytest.fixture
def traced(monkeypatch, tmp_path, folder):
    """Return a function that runs a command: all that it asks for, prints and ends with, in one text."""
    monkeypatch.chdir(tmp_path)
    calls = MagicMock()
    for module in RECORDED:  # before any is patched: what they import by name stays as it is
        importlib.import_module(module)
    for module, names in RECORDED.items():
        for name in names.split():
            monkeypatch.setattr(f"{module}.{name}", getattr(calls, f"{module}.{name}".replace(".", "_")))
    # settings, and the name of a folder, have all that is typed, used or not
    for name in ("out", "results"):
        (tmp_path / name).mkdir()
    taken = []

    def settings_of(*of, rows=None, **more):
        taken.append(f"depends on {of}, {more}" + (f", rows by {', '.join(rows)}" if rows else ""))
        return {}

    monkeypatch.setattr("tuning.writing.record.settings_of", settings_of)
    monkeypatch.setattr(
        "tuning.writing.record.own_folder",
        lambda base, _, varied: taken.append(f"takes {base}{', varied' * varied}") or tmp_path / "out",
    )
    monkeypatch.setattr("tuning.writing.record.walks_at_home", lambda walks, *_: walks)

    def wrote(*_, answer, **__):
        written = SimpleNamespace(tables=(1,), outcome=(), files="files", summary="{}")
        answer(written)
        return written

    scenario, found = mc.load_scenario(CONFIG), Found()
    log = SimpleNamespace(guessed=None, digest="", warnings=(), signals={"base.moment.z": ()}, source="log.csv")
    returned = {
        "mjx_climb.metrics": MEASURED,
        "mjx_climb.inputs.time_step.largest_time_step": 0.0005,
        "mjx_climb.viz.rendering.save_image": "picture",
        "mjx_climb.viz.recording.save_mcap": SimpleNamespace(name="walk.mcap"),
        "mjx_climb.viz.rerun_recording.save_rrd": SimpleNamespace(name="walk.rrd"),
        "tuning.proposal.propose.propose": SimpleNamespace(
            sections=scenario.model_dump(exclude={"time_step"}), notes=[("a", "b", "c")]
        ),
        "tuning.proposal.stand.on_stand": "hubrobo_v3_2",
        "tuning.comparisons.first_walks.heavy_load": "",
        "tuning.comparisons.first_walks.on_ceiling": None,
        "tuning.comparisons.first_walks.slow_enough": (scenario, True, "as it is", 0.5, {}),
        "tuning.comparisons.first_walks.with_joint_gains": (scenario, "as they are"),
        "tuning.benchmarks.measure.measure": defaultdict(float, devices=["cpu"], versions={"mujoco": ""}),
        "tuning.command_line.cache.cache": [SimpleNamespace(text="")],
        "tuning.command_line.machine.examine": [],
        "tuning.comparisons.linear_margins.warnings": [],
        "tuning.writing.folder.fill": "files",
        "tuning.comparisons.margins.warnings": [],
        "tuning.identification.readers.read_log": log,
        "tuning.results.config_file.write_config": scenario,
        "tuning.pages.redrawn.figures": [("map", calls.figure)],
        "tuning.numbers.number": "1",
        "tuning.numbers.to_json": "{}",
        "tuning.reproduce.results.as_markdown": "",
        "tuning.searches.shards.find": [
            SimpleNamespace(about={"repeat": "as before", "name": "mine", "settings": "{}"}, identity={"kind": "sweep"})
        ],
        "tuning.pages.runs.write": "runs.html",
        "mjx_climb.files.dataset.write_text_atomically": "the file",
        "tuning.pages.runs.below": [
            SimpleNamespace(when=datetime(2026, 1, 2, 15, 4, 5), name="a", differs="b", said="c", plain={"d": 1})
        ],
        "tuning.searches.shards.home": tmp_path / "home",
        "tuning.searches.shards.Rows": SimpleNamespace(
            rows=range(6), there=2, folder=None, shard=None, walk=lambda _: None
        ),
    }  # fmt: skip
    returned |= dict.fromkeys(
        (
            "tuning.comparisons.compare.run", "tuning.comparisons.judge.Draw.result", "tuning.searches.pareto.run",
            "tuning.comparisons.degraded.Worse.result",
            "tuning.searches.schedule.run", "tuning.comparisons.merge.merged", "tuning.searches.sweep.Grid.result",
            "tuning.searches.ceiling.ceiling",
            "tuning.searches.tune.from_seeds",
        ),
        found,
    )  # fmt: skip
    # a work begins when its result is asked for
    calls.tuning_background_background.return_value.__enter__.return_value = lambda work: lambda _: work(None)
    for name, value in returned.items():
        assert name.rpartition(".")[2] in RECORDED.get(name.rpartition(".")[0], "") or name.count(".") > 3
        getattr(calls, name.replace(".", "_")).return_value = value
    calls.tuning_kinds_write.side_effect = wrote
    calls.tuning_identification_fit_identify_identify.return_value.as_json.return_value = {}
    calls.tuning_identification_model_replay_simulate.return_value.scenario = scenario
    loaded, load_scenario = {}, mc.load_scenario

    def load_once(source, changes=()):
        key = repr((source, dict(changes)))
        if key not in loaded:
            loaded[key] = load_scenario(source, changes)
        return loaded[key]

    monkeypatch.setattr(mc, "load_scenario", load_once)
    monkeypatch.setattr(devices, "usable_cores", lambda: 4)

    def run(line):
        calls.reset_mock()
        taken.clear()
        shutil.rmtree("elsewhere", ignore_errors=True)  # as another form of the command left it
        command, *words = line.format(folder=folder, config=CONFIG).split()
        with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(out):
            try:
                run.code = command_line(command)([command, *words], standalone_mode=False) or 0
            except mc.ConfigError as error:
                return f"{REFUSED}{error}"
        calls_alone = re.sub(r"0x[0-9a-f]+|id='\d+'|\.[0-9a-f]{12}\.part", "", "\n".join(map(repr, calls.mock_calls)))
        return re.sub(r"[\d.]+ s\b", "", out.getvalue()) + calls_alone

    run.taken = taken
    return run


ASKED = (
    "run {config} --compare pd --video --snapshots --at 0.1 --mcap",
    "run {config} --set control.reading=measured_pose --compare end_effector_admittance --video --snapshots --at "
    "0.1,0.2 --size 640x480 --view --rerun --figures svg,pdf",
    "sweep {config} --stiffness 1:2:2 --damping 1:3:2 --gains {folder}/held.yaml",
    "sweep {config} --stiffness 1:2:2 --damping 1:3:2 --shard 2/3", "sweep --merge folder",
    "sweep --merge folder --merge other --out elsewhere", "runs folder --out elsewhere --json",
    "tune {config}", "tune {config} --seeds 2 --starts 3 --with-joint-gains --metric {folder}/mine.py:highest",
    "tune {config} --ensemble {folder}/ensemble.yaml --test-members 8",
    "tune {config} --law pd --law base_admittance --also inertia --members 3",
    "tune {config} --law pd --law base_admittance --weight travel=2 --test-members 5 --seeds 2 --hardware mx_64",
    "tune {config} --against base_deviation --better peak_foot_force --points 3",
    "tune {config} --over gravity,cargo --space split",
    "evaluate {config} --gains {folder}/held.yaml --retuned-pd {folder}/gains.yaml --members 4",
    "evaluate {config} --gains {folder}/held.yaml --ensemble {folder}/ensemble.yaml --shard 1/2",
    "evaluate {config} --gains {folder}/held.yaml --margins --retuned-pd {folder}/gains.yaml",
    "evaluate {config} --margins --margin contact.damping=x0.5 --margin control.kd=0.1 --set control.controller=pd",
    "evaluate {config} --gains {folder}/gait.yaml --margins --controller end_effector_admittance",
    "evaluate {config} --gains {folder}/held.yaml --worse force_sensor.noise=0.5 --worse servo.backlash=0.01 "
    "--members 3",
    "evaluate {config} --gains {folder}/held.yaml --ceiling --against base_deviation --members 3",
    "evaluate {config} --ceiling --set control.controller=pd",
    "evaluate {config} --gains {folder}/held.yaml --pushes --push-length 0.5 --set control.recovery.shift=0.02",
    "evaluate {config} --pushes --set control.controller=pd", "evaluate --merge folder",
    "replay {config} --log log.csv --video --with-law",
    "evaluate {config} --gains {folder}/mine.yaml --law {folder}/mine.py:Mine --pushes --push-length 0.5 "
    "--push-length 0.1 --largest-push 30 --push-draws 9 --engine mjx",
    "evaluate {config} --gains {folder}/held.yaml --ceiling --delays 0.01,0.02 --knots 0.2,0.1 --iterations 7 --weight "
    "travel=2 --limit min_tsm=0.1 --test-members 5 --ensemble {folder}/ensemble.yaml --against travel --better min_tsm "
    "--points 4",
    "excite {config} --fit control.kp --fit control.kd --family chirp --duration 3 --low 0.2 --high 5 --kp 30 --kp 60 "
    "--mass 0.1 --drop --limb-by-limb --rate 50 --noise 1e-3 --margin 0.5 --candidates 3 --seed 5",
    "identify {config} --log log.csv --fit control.kp --fit gravity --signals signals.yaml --base held --mass 0.1 "
    "--held-out 0.3 --starts 2 --out elsewhere",
    "replay {config} --log log.csv --signals signals.yaml --base held --mass 0.1",
    "robot robot.xml --gravity 1.62 --slope 30 --base trunk --limbs a,b", "robot robot.xml --write dog.yaml --roof",
    "robot robot.xml --gravity 0", "robot robot.xml --stand --base trunk --slope 90",
    "export {folder}/held.yaml --format ros2_control --update-rate 500 --name mine",
    "export {folder}/held.yaml --format admittance_control --update-rate 500 --out elsewhere",
    "export {folder}/gait.yaml --format csv", "export {folder}/gait.yaml --format json --config {config} --engine mjx",
    "export {folder}/held.yaml --config {folder}/filtered.yaml", "export {folder}/transfer.yaml --update-rate 250",
    "export {folder}/held.yaml --config {folder}/filtered.yaml --format admittance_control --update-rate 200",
    "export {folder}/held.yaml --config {folder}/by_law.yaml",
    "export {folder}/transfer.yaml --config {folder}/by_law.yaml",
)  # fmt: skip
LONG = re.compile(
    r"\b(Scenario|Robot|Parameters|Structure|MetricTable|Ensemble|Search|Ceiling|Space|array|Objective)\("
)
OF_MOCKS = re.compile(r"^call\..*__(?:iter|len|enter|exit)__\(.*\n", re.MULTILINE)


def shortened(text):
    """Return a text with a number in place of each long value; settings stand below it, equal ones once."""
    known = defaultdict(list)
    text = OF_MOCKS.sub("", text).replace(repr(MEASURED), "METRICS")
    whole = mc.load_scenario(CONFIG).to_yaml()
    text = re.sub(r"\nwalked:\n(?:  .*\n)+", "\nwalked: ...\n", text)
    text = text.replace(whole, "SCENARIO\n").replace(repr(whole), "SCENARIO")
    text = re.sub(r"<MagicMock name='mock\.([^']*)' >", r"\1", text).replace("\ncall.", "\n")
    while found := LONG.search(text):
        end, depth = found.end(), 1
        while depth:
            depth += {"(": 1, ")": -1}.get(text[end], 0)
            end += 1
        name, value = found[1], text[found.start() : end]
        if value not in known[name]:
            known[name].append(value)
        text = f"{text[: found.start()]}{name} {known[name].index(value) + 1}{text[end:]}"
    kinds = ("Search", "Ensemble", "Ceiling")
    return "\n".join([text, *(f"{kind} {n + 1}: {each}" for kind in kinds for n, each in enumerate(known[kind])), ""])


def lines_of(command):
    """Yield for each option of each form of a command two lines: without it, or with another value, and with it."""
    made = program(command)
    (options,) = (each.callback.options for each in made.registered_commands if each.name == command)
    for form, names in options.items():
        key = f"{command} {form}".strip()
        needed = LINES.get(key, ALONE)
        line = f"{command} {needed}"
        for name in names:
            if name in PLACED and PLACED[name][0] in line:
                yield line, line.replace(*PLACED[name])
                continue
            for words in OWN.get(f"{key} {name}", [TYPED.get(name)]):
                assert words is not None, f"{key} --{name}: type something for it in this file"
                own = "" if words in needed.split() else needed  # a flag that asks for the form
                whole = words if words.startswith("{config}") else f"{own} {words}"
                before = whole.split()[: -1 if words.split()[-1].startswith("--") else -2]  # a flag, or a value too
                yield " ".join([command, *before]), f"{command} {whole}"
    shown = {parameter.name for parameter in command_line(command).commands[command].params}
    assert shown == set().union(*options.values())


@pytest.mark.parametrize(  # two have many options
    "command", [pytest.param(c, marks=[pytest.mark.slow] * (c in ("tune", "evaluate"))) for c in COMMANDS]
)
def test_every_option_changes_what_a_command_asks_for_or_says(command, traced):
    """An option that is parsed and not used leaves the recorded calls and the printed text as they are without it."""
    known = functools.cache(traced)
    for without, with_it in lines_of(command):
        assert not known(with_it).startswith(REFUSED), known(with_it)
        assert known(without) != known(with_it), with_it
    line = f"{command} {LINES.get(command, ALONE)}"
    assert traced(line) == traced(line)  # else all would differ


def test_of_two_walks_that_are_compared_the_rival_is_shown_first_and_the_walk_itself_measured_first(traced):
    shown = re.search(r"show\({'(\w+)'.*?}, {'(\w+)'", traced("run {config} --compare pd"))
    assert shown.groups() == ("pd", "base_admittance")


def test_a_setting_that_is_typed_counts_more_than_the_file_even_where_it_is_the_default(tmp_path):
    """Typed are all defaults, in the file is another value for each."""
    others = {
        "method": "grid", "space": "split", "inertia": True, "also": ("inertia",), "joint_gains": True,
        "bounds": {"damping": (1.0, 2.0)}, "pins": {"stiffness": 1.0}, "frozen": ("inertia",),
        "weights": {"peak_foot_force": 2.0}, "limits": {"travel": 1.0}, "deviation_factor": 2.0,
        "no_worse_than_pd": False, "starts": 3, "iterations": 2, "seed": 7, "precision": "float64",
    }  # fmt: skip
    assert others.keys() == Search.model_fields.keys()
    (tmp_path / "search.yaml").write_text(Search(**others).to_yaml())
    file, loaded = SearchFile(search=tmp_path / "search.yaml"), SimpleNamespace(metrics=mc.METRICS)
    for name, default in Search().model_dump().items():
        joined = file.joined(Search(**{name: default}), loaded)
        assert joined == Search(**others | {name: default})


@pytest.mark.parametrize("line", ASKED)
def test_what_a_command_asks_for_is_what_was_approved(line, traced, folder, tmp_path, cpu_alone):
    """Calls of what takes long, draws or writes, with their arguments, what is printed, and all that a result is of."""
    (tmp_path / "folder").mkdir()
    before = ARGUMENTS.set(line.format(folder=folder, config=CONFIG).split())
    try:
        text = shortened("\n".join([traced(line), *traced.taken]))
    finally:
        ARGUMENTS.reset(before)
    text = text.replace(str(folder), "FOLDER").replace(str(tmp_path), "HERE")
    text = re.sub(r"\.out\.[0-9a-f]{8}", ".out", text.replace(str(ROOT), "ROOT"))
    name = re.sub(r"[^a-z0-9]+", "_", line.replace("{config}", "").replace("{folder}", ""))[:90].strip("_")
    approved.check(Path(__file__).parent / "approved" / "asked" / f"{name}.txt", text)


@pytest.mark.parametrize("write", ["", " --write dog.yaml"])
@pytest.mark.parametrize("walks", [True, False])
def test_a_robot_that_walks_at_no_gait_is_proposed_all_the_same_and_ends_with_1(walks, write, traced, monkeypatch):
    slow_enough = (mc.load_scenario(CONFIG), walks, "as it is", 0.5, {})
    first_walks = "tuning.comparisons.first_walks"
    monkeypatch.setattr(f"{first_walks}.slow_enough", lambda *_: slow_enough)
    monkeypatch.setattr(f"{first_walks}.on_ceiling", lambda *_: (bool(write), "of 30 N"))
    monkeypatch.setattr(f"{first_walks}.heavy_load", lambda *how: f"{how[1]:g} of the limit")
    text = traced(f"robot robot.xml{write}")
    assert traced.code == (0 if walks else 1)
    assert f"{'taken ' if walks else 'failed'}   walk" in text and re.search("warning +load +0.5 of the limit", text)
    assert ("mjx-climb run dog.yaml" if write else "time_step: 0.001") in text
    assert bool(re.search(rf"{'taken' if write else 'warning'} +ceiling +of 30 N", text)) is walks


def test_a_robot_that_cannot_be_drawn_is_written_and_the_reason_said(traced, monkeypatch):
    def fail(*_):
        raise RenderingError("no OpenGL")

    monkeypatch.setattr("mjx_climb.viz.rendering.save_image", fail)
    assert "no picture: no OpenGL" in traced("robot robot.xml --write dog.yaml") and traced.code == 0


def test_a_shard_that_is_not_the_last_says_who_merges(traced, monkeypatch):
    shard = SimpleNamespace(number=2, count=3)
    rows = SimpleNamespace(rows=range(5), there=2, folder=Path("part"), shard=shard, walk=lambda _: None)

    def joined(*_):
        raise mc.ConfigError("out", "", "all shards", "one")

    monkeypatch.setattr("tuning.searches.shards.Rows", lambda *_: rows)
    monkeypatch.setattr("tuning.searches.shards.joined", joined)
    text = traced("sweep {config} --stiffness 1:2:2 --damping 1:3:2 --shard 2/3 --json")
    assert "part is whole; the last of 3 shards writes the result, and so does mjx-climb sweep --merge " in text
    assert '{"shard": 2, "of": 3, "walks": 5}' in text and "shard 2/3; 2 are there already" in text


@pytest.mark.parametrize(
    ("found", "code"),
    [({}, 0), ({"detached_limb": "LF", "detached_at": 0.1}, 1), ({"diverged": True}, 1), ({"stands_at": 0.0}, 1),
     ({"stands_at": None, "missed_grips": 2}, 0)],
)  # fmt: skip
def test_a_walk_that_fails_ends_with_1(found, code, traced, monkeypatch):
    monkeypatch.setattr(mc, "metrics", lambda *_: MEASURED | {"stands_at": None} | found)
    traced("run {config}")
    assert traced.code == code
