"""Pictures: what must be seen on them is there."""

import dataclasses
import subprocess
import sys

import numpy as np
import pytest
import xarray as xr
from matplotlib import colormaps
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import PathPatch

import mjx_climb as mc
from mjx_climb.viz import plots
from mjx_climb.viz.plots import styling

CASE = {
    "duration": 2.0,
    "gravity": [0.0, 0.0, -9.81e-6],
    "control.stiffness": [5e4] * 6,  # the same program then serves tests/files/test_dataset.py
    "disturbance.pushes": [{"force": [-5.0, 0.0, 0.0], "start": 1.0, "stop": 1.5}],
    "disturbance.cargo.mass": 0.5,
    "disturbance.cargo.start": 1.7,
}


@pytest.fixture(scope="module")
def walk():
    return mc.rollout(mc.Scenario().with_overrides(CASE))


@pytest.fixture(scope="module")
def torn():
    """The same walk with weak grippers: one program serves both."""
    return mc.rollout(mc.Scenario().with_overrides({**CASE, "contact.holding_limit": 2.0}))


def grid(**more):
    """Metrics over 4 stiffnesses and 3 dampings: one walk lost a gripper, one diverged."""
    values = np.geomspace(1.0, 2.0, 12).reshape(4, 3)
    values[3, 0] = np.nan
    limb = np.full((4, 3), -1)
    limb[2, 0] = 1
    names = {"flag_values": [-1, 0, 1, 2, 3], "flag_meanings": "none LF LH RH RF", "units": "1"}
    data = {
        "peak_foot_force": (values, {"units": "N", "long_name": "peak foot force"}),
        "min_gia_margin": (values, {"units": "m/s^2", "long_name": "smallest GIA margin"}),
        "cost_of_transport": (values**8, {"units": "1", "long_name": "cost of transport"}),
        "detached_limb": (limb, names),
        "diverged": (np.isnan(values), {}),
    }
    variables = {
        name: (("stiffness", "damping"), np.full((4, 3), more.get(name, numbers)), attributes)
        for name, (numbers, attributes) in data.items()
    }
    return xr.Dataset(variables, {"stiffness": [1e2, 1e3, 1e4, 1e5], "damping": [1e0, 1e2, 1e4]})


def find(figure, gid):
    return figure.findobj(lambda artist: artist.get_gid() == gid)


def texts(figure):
    return {text.get_text() for text in figure.findobj(lambda artist: hasattr(artist, "get_text"))}


def y_labels(figure):
    return [" ".join(axes.get_ylabel().split()) for axes in figure.axes]


def cells(figure):
    """Return the values that the first map of a figure shows (y, x), and their scale."""
    mesh = figure.axes[0].collections[0]
    return mesh.get_array(), mesh.norm


def test_thin_keeps_the_extremes_and_the_ends():
    time = np.arange(8000) * 1e-3
    values = np.sin(time)
    values[[17, 4321]] = 9.0, -9.0
    thin_time, thin_values = plots.thin(time, values)
    assert thin_time.size <= 1502 and (np.diff(thin_time) > 0).all()
    assert (thin_values.max(), thin_values.min()) == (9.0, -9.0)
    assert (thin_time[0], thin_time[-1]) == (time[0], time[-1])


def assert_drawn(panel, walk, expected):
    """Compare the lines over time that a panel shows, without its marks."""
    found = [line for line in panel.lines if len(line.get_xdata()) > 2]
    assert len(found) == len(expected), panel.get_ylabel()
    for line, values in zip(found, expected, strict=True):
        time, values = plots.thin(walk.time, values)
        np.testing.assert_allclose(line.get_xdata(), time)
        np.testing.assert_allclose(line.get_ydata(), values, err_msg=panel.get_ylabel())


def shown(walk):
    """Return the lines of every panel: millimetres where the axis says so."""
    return {
        "largest foot force [N]": [np.linalg.norm(walk.foot_force, axis=2).max(1)],
        "largest joint torque [N m]": np.abs(walk.joint_torque).max(2).T,
        "base off ref. [mm]": 1e3 * (walk.base_position - walk.base_reference).T,
        "shift $\\Delta x$ [mm]": 1e3 * walk.base_displacement.T[:3],
        "TSM [m]": [walk.tsm],
        "GIA margin [m/s$^2$]": [walk.gia_margin],
        "support": [],
    }


def test_every_panel_of_a_walk_shows_its_series(walk):
    """And for how long each limb's gripper holds. A page has room for seven panels."""
    figure, expected = plots.plot_walk(walk), shown(walk)
    assert y_labels(figure) == list(expected) and figure.axes[-1].get_xlabel() == "time [s]"
    for panel, values in zip(figure.axes, expected.values(), strict=True):
        assert_drawn(panel, walk, values)
    for bars, limb in zip(find(figure.axes[-1], "support"), walk.support.T, strict=True):
        times = [path.vertices[:-1, 0] for path in bars.get_paths()]
        assert sum(np.ptp(time) for time in times) == pytest.approx(limb.sum() * walk.scenario.time_step)
        assert min(time.min() for time in times) == walk.time[limb.argmax()]


def test_a_mark_is_on_its_line(torn):
    """The red cross: in every panel, on the line of several that is furthest from zero."""
    (instant, limb), *_ = plots.detachments(torn)
    row = int(np.searchsorted(torn.time, instant))
    figure = plots.plot_walk(torn)
    crosses = [find(panel, "detachment")[0] for panel in figure.axes]
    assert {(cross.get_color(), cross.get_xdata()[0]) for cross in crosses} == {(plots.RED, instant)}
    expected = [max((line[row] for line in lines), key=abs) for lines in list(shown(torn).values())[:-1]]
    places = [cross.get_ydata()[0] for cross in crosses]
    np.testing.assert_allclose(places, [*expected, torn.limbs.index(limb)], rtol=1e-12)
    (label,) = find(figure, "failure")
    assert label.get_text().startswith(f"{limb} torn off, {instant:.2f} s")
    assert instant == pytest.approx(mc.metrics(torn)["detached_at"])


def test_every_panel_of_a_comparison_shows_its_series(walk, torn):
    def lines(trajectory):
        torque = np.abs(trajectory.joint_torque).max(2)
        error = np.linalg.norm(trajectory.base_position - trajectory.base_reference, axis=1)
        force = np.linalg.norm(trajectory.foot_force, axis=2).max(1)
        return [force, torque.max(1), *torque.T, trajectory.tsm, trajectory.gia_margin, 1e3 * error]

    figure = plots.plot_comparison({"pd": walk, "proposed": torn}, "Case 2", per_limb=True)
    for panel, expected in zip(figure.axes, zip(lines(walk), lines(torn), strict=True), strict=True):
        assert_drawn(panel, walk, expected)
    of_limbs = [f"{limb} largest torque [N m]" for limb in walk.limbs]
    margins = ["TSM [m]", "GIA margin [m/s$^2$]", "base off its reference [mm]"]
    assert y_labels(figure) == ["largest foot force [N]", "largest joint torque [N m]", *of_limbs, *margins]
    assert {"pd", "proposed", "Case 2"} <= texts(figure)
    assert len(find(figure, "detachment")) == len(figure.axes)
    weightless = dataclasses.replace(walk, tsm=np.full_like(walk.tsm, np.nan))
    assert y_labels(plots.plot_comparison({"pd": weightless, "proposed": torn})).count("TSM [m]") == 1
    assert "TSM [m]" not in y_labels(plots.plot_comparison({"pd": weightless}))
    assert len(plots.plot_comparison({"pd": walk}).axes) == 5
    with pytest.raises(ValueError, match="at least one walk"):
        plots.plot_comparison({})


def test_walk_marks_grip_changes_and_disturbances(walk):
    figure = plots.plot_walk(walk)
    assert [text.get_text() for text in find(figure, "disturbance label")] == ["cargo 0.5 kg", "\N{MINUS SIGN}5 N x"]
    assert len(find(figure, "disturbance")) == 2 * len(figure.axes)
    changes = {line.get_xdata()[0] for line in find(figure.axes[0], "grip change")}
    assert min(abs(change - 1.0) for change in changes) < 0.01
    assert not find(figure, "detachment") and not find(figure, "failure")


def test_a_walk_that_diverged_without_gravity_or_a_law(walk, tmp_path):
    """Its state grows without bound from 0.8 s on; there is no TSM, and no shift of the base."""
    late = np.maximum(walk.time - 0.8, 0)
    growth = np.where(late < 0.1, np.exp(np.minimum(1000 * late, 300)), np.nan)
    changes = {"tsm": np.full_like(walk.tsm, np.nan), "base_displacement": np.zeros_like(walk.base_displacement)}
    for name in ("base_position", "joint_rates", "foot_force", "joint_torque"):
        values = getattr(walk, name)
        changes[name] = values * growth.reshape(-1, *[1] * (values.ndim - 1))
    figure = plots.plot_walk(dataclasses.replace(walk, **changes))
    (label,) = find(figure, "failure")
    assert label.get_text() == "diverged, 0.90 s"
    assert figure.axes[0].get_ylim()[1] < 100
    assert not any("Delta" in label or "TSM" in label for label in y_labels(figure))
    plots.save_figure(figure, tmp_path / "diverged", dpi=50)


@pytest.mark.parametrize("draw", [plots.plot_walk, lambda gone: plots.plot_comparison({"pd": gone})])
def test_a_walk_that_diverged_at_once_is_drawn(walk, draw, tmp_path):
    names = ("base_position", "foot_position", "foot_force", "joint_torque", "joint_angles", "joint_rates", "tsm")
    names += ("gia_margin", "base_displacement")
    figure = draw(dataclasses.replace(walk, **{name: np.full_like(getattr(walk, name), np.nan) for name in names}))
    assert [label.get_text() for label in find(figure, "failure")] == ["diverged, 0.00 s"]
    plots.save_figure(figure, tmp_path / "gone", dpi=50)


def test_feet_go_where_they_went(walk, torn):
    """From the side and from above, in mm from where the base starts: four feet, then the base; up to a failure."""
    paths = 1e3 * np.concatenate([walk.foot_position, walk.base_position[:, None]], axis=1)
    paths[..., :2] -= 1e3 * walk.base_reference[0, :2]
    for panel, axis in zip(plots.plot_feet(walk).axes, (2, 1), strict=True):
        drawn = [line for line in panel.lines if len(line.get_xdata()) > 10]
        for line, path in zip(drawn, paths.swapaxes(0, 1), strict=True):
            np.testing.assert_allclose(np.transpose(line.get_data()), path[:, [0, axis]], atol=1e-9)
    figure = plots.plot_feet(torn)
    (label,) = find(figure, "failure")
    assert len(find(figure, "detachment")) >= 2 and "torn off" in label.get_text()


def test_feet_are_drawn_on_the_ground_that_the_scenario_has(walk):
    ground = {"LF": [0.0, 0.01], "LH": [0.0], "RH": [-0.02], "RF": [0.0]}
    uneven = dataclasses.replace(walk, scenario=walk.scenario.with_overrides({"ground.footholds": ground}))
    side, above = plots.plot_feet(uneven).axes
    assert {round(float(bar.get_ydata()[0]), 6) for bar in find(side, "foothold")} == {0.0, 10.0, -20.0}
    assert side.get_ylim()[0] < -20
    np.testing.assert_allclose(find(above, "foothold")[0].get_xdata()[0], 1e3 * walk.foot_position[0, 0, 0], atol=1)
    assert (side.get_ylabel(), above.get_xlabel()) == ("height [mm]", "ahead [mm]")
    assert side.get_aspect() == above.get_aspect() == 1
    assert {bar.get_ydata()[0] for bar in find(plots.plot_feet(walk).axes[0], "foothold")} == {0.0}


def test_a_height_map_is_drawn_where_it_lies(walk, tmp_path):
    np.save(tmp_path / "map.npy", [[0.0, 0.001], [0.002, 0.003]])
    ground = {"file": str(tmp_path / "map.npy"), "resolution": 1.0, "origin": [-0.5, -0.5]}
    changes = {"ground.map": ground, "gait.heading": np.pi / 2}
    figure = plots.plot_feet(dataclasses.replace(walk, scenario=walk.scenario.with_overrides(changes)))
    (mesh,) = find(figure, "relief")
    start = 1e3 * walk.base_reference[0, :2]
    corners = mesh.get_coordinates()[..., :2].reshape(-1, 2)
    # walking along y: ahead is y, to the left is -x
    np.testing.assert_allclose(corners[0], [-500 - start[1], 500 + start[0]])
    np.testing.assert_allclose(np.ravel(mesh.get_array()), [0, 1, 2, 3])
    assert "ground [mm]" in y_labels(figure)


def test_map_shows_each_value_at_its_gains_with_units_marks_and_baseline():
    marks = {"paper": (5e4, 5e3), "best": (3e3, 1e2), "beside the grid": (4e7, 1e4)}
    figure = plots.plot_map(grid(), "peak_foot_force", marks, baseline=1.5)
    panel, bar = figure.axes
    np.testing.assert_array_equal(cells(figure)[0], np.ma.masked_invalid(grid()["peak_foot_force"].values.T))
    np.testing.assert_allclose(panel.collections[0].get_coordinates()[1, 2], [10**3.5, 1e1])
    assert (panel.get_xscale(), panel.get_yscale()) == ("log", "log")
    assert panel.get_xlabel() == "stiffness" and panel.get_ylabel() == "damping"
    assert bar.get_ylabel() == "peak foot force [N]"
    assert [line.get_ydata()[0] for line in find(bar, "baseline")] == [1.5]
    drawn = {line.get_label(): line for line in panel.lines}
    assert {name: (line.get_xdata()[0], line.get_ydata()[0]) for name, line in drawn.items()} == marks
    assert [name for name, line in drawn.items() if line.get_marker() == "*"] == ["best"]  # without one: no star
    assert len({line.get_marker() for line in drawn.values()}) == 3 and panel.get_xlim()[1] > 4e7
    assert {*marks, "gripper torn off", "diverged", "no value", "pd"} <= texts(figure)
    # the first dimension of a metric runs along the horizontal axis
    upright, turned = (plots.plot_map(data, "peak_foot_force") for data in (grid(), grid().transpose()))
    assert turned.axes[0].get_xlabel() == "damping" and turned.axes[0].get_xlim() == upright.axes[0].get_ylim()
    np.testing.assert_array_equal(np.ma.filled(cells(turned)[0], 0), np.ma.filled(cells(upright)[0], 0).T)


def test_map_hatches_failed_walks_and_scales_by_the_others():
    dataset = grid()
    dataset["peak_foot_force"][2, 0] = 1e6
    figure = plots.plot_map(dataset, "peak_foot_force")
    for name, hatch, corner in (("gripper torn off", "/", (10**3.5, 0.1)), ("diverged", "x", (10**4.5, 0.1))):
        (hatched,) = find(figure, name)
        assert isinstance(hatched, PathPatch) and set(hatched.get_hatch()) == {hatch}
        ((polygon),) = hatched.get_path().to_polygons()
        np.testing.assert_allclose(polygon.min(0), corner)
    assert cells(figure)[1].vmax < 3
    figure = plots.plot_map(grid(peak_foot_force=np.nan, diverged=True), "peak_foot_force", baseline=2.0)
    corners = np.concatenate(find(figure, "diverged")[0].get_path().to_polygons())
    np.testing.assert_allclose([corners.min(0), corners.max(0)], [[10**1.5, 0.1], [10**5.5, 1e5]])
    assert not np.isfinite(np.ma.filled(cells(figure)[0], np.nan)).any()


def test_the_colours_of_a_map_are_for_what_is_near_the_baseline_or_better():
    dataset = grid(peak_foot_force=np.linspace(1.0, 40.0, 12).reshape(4, 3)).drop_vars(["detached_limb", "diverged"])
    smaller = cells(plots.plot_map(dataset, "peak_foot_force", baseline=4.0))[1]
    assert smaller.vmin < 4.0 and smaller.vmax == pytest.approx(4.0 + 3 * (4.0 - smaller.vmin))
    dataset = dataset.rename(peak_foot_force="min_tsm", min_gia_margin="other")
    larger = cells(plots.plot_map(dataset, "min_tsm", baseline=37.0))[1]
    assert larger.vmax > 37.0 and larger.vmin == pytest.approx(37.0 - 3 * (larger.vmax - 37.0))


@pytest.mark.parametrize("draw", [plots.plot_map, lambda data, metric: plots.plot_maps(data, ["diverged", metric])])
def test_map_rejects_what_it_cannot_draw(draw):
    data = grid().assign(history=(("stiffness", "damping", "time"), np.zeros((4, 3, 2))))
    for metric, lowest, message in (
        ("speed", 1.0, "speed: expected one of peak_foot_force"),
        ("history", 1.0, "history: expected two dimensions, got stiffness, damping, time"),
        ("peak_foot_force", 0.0, "above 0"),
    ):
        with pytest.raises(ValueError, match=message):
            draw(data.assign_coords(damping=[lowest, 2.0, 3.0]), metric)


def test_sheet_of_maps(tmp_path):
    metrics = ["peak_foot_force", "min_gia_margin", "cost_of_transport", "detached_limb", "diverged"]
    figure = plots.plot_maps(grid(), metrics, {"paper": (5e4, 5e3)}, baselines={"peak_foot_force": 9.0})
    titles = [axes.get_title(loc="left") for axes in figure.axes if axes.get_title(loc="left")]
    assert titles[:3] == ["peak foot force [N]", "smallest GIA margin [m/s$^2$]", "cost of transport"]
    assert {"none", "LF", "LH", "RH", "RF", "pd \N{UPWARDS ARROW}"} <= texts(figure)
    for panel, name in zip(figure.axes, metrics[:3], strict=False):
        shown = np.ma.filled(panel.collections[0].get_array(), np.nan)
        np.testing.assert_array_equal(shown, grid()[name].values.T, err_msg=name)
    [path] = plots.save_figure(figure, tmp_path / "out" / "sheet.v1", dpi=50)
    assert path.name == "sheet.v1.png"
    same = plots.plot_map(grid(cost_of_transport=0.0), "cost_of_transport", baseline=0.0)
    assert "all cells: 0" in texts(same) and not find(same, "baseline")
    assert np.ptp(same.axes[0].collections[0].to_rgba([0.0])[0, :3]) == 0  # in no colour


def test_the_limit_of_stability_runs_between_the_cells_on_both_sides_of_it():
    log = np.log10(grid()["stiffness"]) + 0 * grid()["damping"]
    (line,) = plots.stability_lines(grid().assign(spectral_radius=1 + 1e-4 * (log - 3.25)))
    np.testing.assert_allclose(np.log10(line[:, 0]), 3.25)
    np.testing.assert_allclose(sorted(line[:, 1]), [1e0, 1e2, 1e4])
    assert plots.stability_lines(grid().assign(spectral_radius=0 * log)) == plots.stability_lines(grid()) == []


@pytest.mark.slow
def test_files_are_small(walk, tmp_path):
    png, svg, pdf = plots.save_figure(plots.plot_walk(walk), tmp_path / "one", plots.FORMATS, dpi=100)
    assert png.stat().st_size < 300_000 and svg.stat().st_size < 600_000 and pdf.stat().st_size < 300_000
    assert pdf.read_bytes().startswith(b"%PDF") and b"/Type3" not in pdf.read_bytes()


def test_package_loads_without_matplotlib():
    code = "import sys, mjx_climb; sys.exit('matplotlib' in sys.modules)"
    subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=True, cwd=mc.__path__[0] + "/..")


@pytest.mark.parametrize(("words", "columns"), [(1, 3), (2, 2), (5, 1)])
def test_a_legend_is_as_wide_as_its_figure_at_most(words, columns):
    """As many columns as there is room for."""
    figure = Figure(figsize=(3.5, 3), layout="constrained")
    handles = [Line2D([], [], label=" ".join(["words"] * words)) for _ in range(6)]
    plots.legend_below(figure, handles, 3)
    [legend] = figure.legends
    figure.draw_without_rendering()
    assert len({round(text.get_window_extent().x0) for text in legend.get_texts()}) == columns
    assert legend.get_window_extent().width <= figure.bbox.width


def test_a_picture_is_saved_as_it_was_rendered_ahead_and_then_as_it_is(tmp_path):
    figure = Figure(figsize=(1, 1))
    saved = [plots.save_figure(figure, tmp_path / "as it is", dpi=50)[0].read_bytes()]
    styling.render_ahead(figure, "png", dpi=50)
    figure.text(0.5, 0.5, "later")
    saved += [plots.save_figure(figure, tmp_path / "as it is", dpi=50)[0].read_bytes() for _ in range(2)]
    assert saved[0] == saved[1] != saved[2]


def test_names_that_are_no_mathematics_are_drawn_as_they_stand(tmp_path):
    """Limbs and joints are called what a user's file calls them."""
    name = r"$\frac{$"
    figure = Figure()
    axes = figure.add_subplot(title=r"$\frac{1}{2}$", ylabel=f"{name}\n[m/s$^2$]")
    axes.plot([0, 1], label=name)
    axes.set_yticks([0, 1], ["a", name])
    figure.legend()
    [path] = plots.save_figure(figure, tmp_path / "names", ("svg",))
    assert path.read_text().count(f"<!-- {name} -->") == 3 and "½" not in path.read_text()
    assert r"<!-- $\frac{1}{2}$ -->" in path.read_text()


@pytest.mark.parametrize(("count", "columns"), [(1, 2), (5, 2), (4, 3)])
def test_a_sheet_has_room_for_its_labels_and_names_each_axis_once(count, columns):
    """Lengths in inches: 0.62 left of it, 0.5 right, 0.75 below, 0.45 above, 0.55 and 0.35 between maps.

    A colour bar and its gap take 7 % of a map's width.
    """
    metrics = ["peak_foot_force", "min_gia_margin", "cost_of_transport", "detached_limb", "diverged"][:count]
    figure = plots.plot_maps(grid(), metrics, {"paper": (5e4, 5e3)}, columns=columns, title="a title")
    wide, high = min(count, columns), -(-count // columns)
    width, height = figure.get_size_inches()
    assert (width, height) == pytest.approx((3.5 * wide, 0.5 + 2.3 * high))
    cell_width, cell_height = (width - 1.12 - 0.55 * (wide - 1)) / wide, (height - 1.2 - 0.35 * (high - 1)) / high
    for number, panel in enumerate(figure.axes[:count]):
        row, column = divmod(number, columns)
        place = panel.get_subplotspec().get_position(figure)
        left, bottom = 0.62 + column * (cell_width + 0.55), 0.75 + (high - 1 - row) * (cell_height + 0.35)
        assert np.multiply(place.extents, [width, height, width, height]) == pytest.approx(
            [left, bottom, left + 0.93 * cell_width, bottom + cell_height]
        )
        lowest = number + columns >= count
        assert panel.get_xlabel() == ("stiffness" if lowest else "")
        assert panel.get_ylabel() == ("" if column else "damping")
        assert panel.xaxis.get_tick_params()["labelbottom"] == lowest
        assert not panel.xaxis.get_minorticklocs().size
    [legend] = figure.legends
    assert legend._ncols == 3 * wide and {"paper", "gripper torn off"} <= {t.get_text() for t in legend.get_texts()}
    assert figure.get_suptitle() == "a title" and len(figure.axes) == 2 * count


@pytest.mark.parametrize("larger", [0, 1])
def test_colours_and_hatches_of_a_map_are_those_of_its_cells(larger):
    """Bright is good; lines are light where a cell is dark, its grey below 0.4, and none of a cell without a value."""
    value = np.linspace(1.0, 2.0, 12).reshape(4, 3)
    value[1, 1] = np.nan
    torn, diverged = np.full((4, 3), np.nan), np.zeros((4, 3), bool)
    torn[[0, 0, 3, 1], [0, 1, 2, 1]], diverged[[2, 3, 0], [0, 1, 0]] = 0.5, True
    dims, own = ("stiffness", "damping"), {"larger_is_better": larger}
    data = xr.Dataset({
        "metric": (dims, value, own), "detached_at": (dims, torn, {}), "diverged": (dims, diverged),
    }, dict(grid().coords))  # fmt: skip
    figure = plots.plot_map(data, "metric", title="a title" if larger else None)
    assert figure.get_suptitle() == ("a title" if larger else "")
    panel = figure.axes[0]
    mesh = panel.collections[0]
    shown = np.where(diverged, np.nan, value)  # what a walk that diverged was until then compares with nothing
    np.testing.assert_array_equal(np.ma.filled(mesh.get_array(), np.nan), shown.T)
    assert (
        mesh.get_cmap().name == ("viridis" if larger else "viridis_r") and panel.get_facecolor()[:3] == (189 / 255,) * 3
    )
    low, high = np.nanpercentile(np.where(np.isfinite(torn) | diverged, np.nan, value), [2, 98])
    x, y = (np.geomspace(ends[0], ends[1], n + 1) for ends, n in (((10**1.5, 10**5.5), 4), ((0.1, 1e5), 3)))
    expected = {}
    for n, m in np.ndindex(4, 3):
        kind = "gripper torn off" if np.isfinite(torn[n, m]) else "diverged" if diverged[n, m] else None
        share = np.clip((shown[n, m] - low) / (high - low), 0, 1)
        grey = colormaps[mesh.get_cmap().name](share)[:3] @ np.array([0.299, 0.587, 0.114])
        if kind:
            dark = np.isfinite(shown[n, m]) and grey < 0.4
            expected.setdefault((kind, "0.85" if dark else "0.15"), []).append([x[n], y[m], x[n + 1], y[m + 1]])
    found = {}
    for patch in [*find(figure, "gripper torn off"), *find(figure, "diverged")]:
        assert patch.get_facecolor()[3] == 0 and patch.get_linewidth() == 0
        tone = "0.85" if patch.get_edgecolor()[0] > 0.5 else "0.15"
        assert patch.get_edgecolor()[:3] == pytest.approx((float(tone),) * 3)
        boxes = [[*each.min(0), *each.max(0)] for each in patch.get_path().to_polygons()]
        found[patch.get_gid(), tone] = boxes
    assert {*found} == {*expected}
    for name, boxes in expected.items():
        area = lambda boxes: sum(np.log(b[2] / b[0]) * np.log(b[3] / b[1]) for b in boxes)  # noqa: E731
        assert area(found[name]) == pytest.approx(area(boxes))
        for edge in (0, 1, 2, 3):
            pick = min if edge < 2 else max
            assert pick(b[edge] for b in found[name]) == pytest.approx(pick(b[edge] for b in boxes))
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    assert legend == ["gripper torn off", "diverged", "no value"]
    at = plots.plot_map(data, "detached_at")
    [*_, held] = [c for c in at.axes[0].collections if c.get_array() is not None]
    np.testing.assert_array_equal(~np.ma.getmaskarray(held.get_array()), (np.isnan(torn) & ~diverged).T)
    assert {"held all the way", "no value"} <= texts(at)
