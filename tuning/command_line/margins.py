"""`mjx-climb margins`: how much worse hardware may be before gains fail."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tuning.command_line.from_models import command
from tuning.command_line.options import Output, Walk
from tuning.command_line.processes import start_devices
from tuning.command_line.program import InputError
from tuning.problem.settings import Options, setting

if TYPE_CHECKING:
    from rich.table import Table

    from tuning.evaluation.linear_margins import Stable
    from tuning.evaluation.margins import Found, Margin


class Rival(Options):
    """What is compared with."""

    retuned_pd: Path | None = setting(
        None, "gains file whose kp and kd pd has too, in a curve of its own", metavar="FILE"
    )

    def joint_gains(self) -> dict[str, float] | None:
        """Return kp and kd of the file, None without one."""
        from tuning.gains import gains_file

        if self.retuned_pd is None:
            return None
        values = gains_file.by_name(gains_file.load(self.retuned_pd))
        if missing := [name for name in ("kp", "kd") if name not in values]:
            expected = f"a gains file with kp and kd, {self.retuned_pd} has no {' and no '.join(missing)}"
            raise InputError(f"--retuned-pd: expected {expected}")
        return {name: values[name] for name in ("kp", "kd")}


@command("results/<config>-margins")
def margins(walk: Annotated[Walk, "-metrics"], rival: Rival, output: Output) -> None:
    """Find how late, slow and weak a robot's hardware may be before gains fail.

    Makes force delay, command delay, control period and joint gains worse, one at a time, on top of the scenario's own
    hardware, and says up to where no gripper is torn off, up to where the force varies less than under pd on the same
    hardware, and up to where the linearised loop is stable. Warns where walks, or the linearised loop, bear less than
    twice what the hardware has.

    Writes to DIR the margins (margins.json), all walks (margins.nc), and the force variation over each quantity, for
    the gains, pd and the config's own gains (margins, in the formats of --figures).

    \b
    Examples:
      mjx-climb margins case_1_2 --gains gains.yaml
      mjx-climb margins case_1_2 --gains gains.yaml --hardware dynamixel_x --json
    """
    with output.session() as shell:
        start_devices()
        from mjx_climb.control import PD
        from tuning.evaluation import linear_margins
        from tuning.evaluation import margins as evaluation
        from tuning.output.folder import write_config

        scenario, law, *_ = walk.load()
        gains = walk.values(law) or {}
        others = {} if walk.gains is None or law is not None else {"config": evaluation.Walker(None, {})}
        if (joint := rival.joint_gains()) is not None:
            others["retuned pd"] = evaluation.Walker(PD(), joint)
        out = shell.claim("margins.json", walk.config.stem, "margins")
        scenario = write_config(scenario, out, law)

        shell.opening(scenario)
        how: dict[str, Any] = {"law": law, "engine": walk.engine}
        with shell.stage("margins") as told:
            found = evaluation.find(scenario, gains, others=others, progress=told, **how)
        with shell.stage("linearised loop", unit="quantities") as told:
            stable = linear_margins.find(scenario, gains, found.margins, progress=told, **how)
        with shell.stage("drawing", compiles=False):
            name = "config" if walk.gains is None else walk.gains.stem
            text, warnings = _write(found, stable, out, name, output.figures)
        shell.show(_table(found.margins, stable), *(f"warning: {line}" for line in warnings))
        pictures = ", ".join(f"margins.{kind}" for kind in output.figures)
        shell.written(f"margins.json, margins.nc, {pictures}, config.yaml", text)


def _write(
    found: "Found", stable: "dict[str, Stable]", folder: Path, given: str, figures: tuple[str, ...]
) -> tuple[str, list[str]]:
    """Write margins and warnings as plain data, SI units, the walks and a picture; return the JSON and the warnings."""
    from mjx_climb import plots
    from mjx_climb.files import dataset
    from tuning.evaluation import linear_margins, margins
    from tuning.report.numbers import to_json
    from tuning.report.pictures import plot_margins

    warnings = margins.warnings(found) + linear_margins.warnings(found.margins, stable)
    each = {
        name: {
            **dataclasses.asdict(margin),
            "needed": margins.needed(name, margin.own),  # the hardware with a factor of two
            "stable": stable[name]._asdict(),
        }
        for name, margin in found.margins.items()
    }
    own = {"holds": found.holds, "better": found.better}
    text = to_json({"own_hardware": own, "margins": each, "warnings": warnings})
    dataset.write_text_atomically(folder / "margins.json", text + "\n")
    dataset.save(found.walks, folder / "margins.nc")
    plots.save_figure(plot_margins(found, given), folder / "margins", figures)
    return text, warnings


def _table(margins: "dict[str, Margin]", stable: "dict[str, Stable]") -> "Table":
    """Return margins beside the scenario's hardware: by walks, and of the linearised loop."""
    from tuning.command_line.session import plain_table
    from tuning.evaluation.margins import QUANTITIES, in_words, with_unit

    table = plain_table("", "hardware", "holds up to", "better than pd up to", "linearised: stable up to")
    for name, margin in margins.items():
        reached = [in_words(name, margin.worst, value) for value in (margin.holds, margin.better)]
        reached.append(in_words(name, stable[name].tried, stable[name].up_to))
        table.add_row(QUANTITIES[name].title, with_unit(name, margin.own), *reached)
    return table
