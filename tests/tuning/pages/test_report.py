"""The report in a real browser: it loads from disk alone; hover, click, small windows and paper do what they say."""

import base64
import dataclasses
import io
import json
import re

import numpy as np
import pytest
import xarray as xr

import mjx_climb as mc
from mjx_climb.walks import LINES, histories
from tests.shell import finish
from tuning import numbers
from tuning.command_line.session import Session
from tuning.comparisons import verdicts, verification
from tuning.comparisons.of_ensemble import SHOWN
from tuning.comparisons.of_front import FrontComparison, verdict
from tuning.comparisons.of_search import TuneComparison
from tuning.comparisons.of_sweep import SweepComparison
from tuning.comparisons.side_by_side import AtOneStep, differences
from tuning.comparisons.worth import of_front
from tuning.pages import comparison, explorer, judge, laws, page, pareto, sweep, tune
from tuning.problem.evaluation import Problem
from tuning.results import front as fronts
from tuning.results import tuned
from tuning.results.front import Front
from tuning.results.swept import Swept
from tuning.searches.pareto import nondominated
from tuning.writing.folder import without_folders

CONFIG = "duration: 0.3\ngravity: [0.0, 0.0, -1.635]\ndisturbance: {cargo: {mass: 1.0, start: 0.05}}\n"
AXES = ["--stiffness", "1e2:1e4:3", "--damping", "1e1:1e3:3"]


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    """A tiny sweep with its page, in a folder whose name must not be told."""
    folder = tmp_path_factory.mktemp("a machine's own")
    (folder / "case.yaml").write_text(CONFIG)
    finish("sweep", folder / "case.yaml", *AXES, "--out", folder / "out")
    with xr.open_dataset(folder / "out" / "sweep.nc", engine="h5netcdf") as grid:
        return folder / "out", grid.load()


@pytest.fixture
def opened(chromium, swept):
    """The browser with the page in a window of the size of a desk."""
    resize(chromium, 1280, 900)
    for kind in ("browser", "performance"):
        chromium.get_log(kind)
    chromium.get((swept[0] / "report.html").as_uri())
    return chromium


def resize(driver, width, height):
    size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)


def find(driver, selector):
    return driver.find_element("css selector", selector)


def point_at(driver, selector):
    from selenium.webdriver import ActionChains

    element = find(driver, selector)
    driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", element)
    return ActionChains(driver).move_to_element(element)


def unpacked(text):
    return np.frombuffer(base64.b64decode(text), "<f4")


def data_of(folder):
    text = (folder / "report.html").read_text()
    return json.loads(re.search(r'id="data">(.*?)</script>', text, re.DOTALL)[1])


@pytest.mark.slow
def test_the_page_holds_all_it_needs_and_nothing_of_this_machine(swept):
    folder, _ = swept
    text = (folder / "report.html").read_text()
    assert len(text) < 5e6
    assert set(re.findall(r"https?://[^/\s\"]+", text)) <= {"http://www.w3.org"}  # names of formats
    for private in (folder.parent.name, str(folder), str(folder.parent.parent)):
        assert private not in text
    assert "mjx-climb sweep case.yaml --stiffness 1e2:1e4:3 --damping 1e1:1e3:3 --out out" in text
    assert "mjx-climb sweep config.yaml --stiffness 1e2:1e4:3 --damping 1e1:1e3:3 --out again" in text
    ids = re.findall(r'\bid="([^"]+)"', text)
    assert len(ids) == len(set(ids))
    assert not list(folder.glob(".*.part"))


@pytest.mark.slow
def test_loads_from_disk_without_errors_and_without_a_network(opened, swept):
    assert opened.get_log("browser") == []
    asked = [json.loads(entry["message"])["message"] for entry in opened.get_log("performance")]
    urls = {e["params"]["request"]["url"] for e in asked if e["method"] == "Network.requestWillBeSent"}
    outside = {url for url in urls if not url.startswith(("data:", "chrome:"))}  # the last of its first, empty tab
    assert outside == {(swept[0] / "report.html").as_uri()}
    assert "force variation" in find(opened, ".verdict").text


@pytest.mark.slow
def test_hover_shows_every_metric_of_the_cell(opened, swept):
    grid = swept[1]
    for cell in (0, 5, 7):  # stiffness runs slower
        point_at(opened, f".map rect[data-cell='{cell}']").perform()
        here = grid.isel(stiffness=cell // 3, damping=cell % 3)
        told = dict(gain.split() for gain in find(opened, ".readout caption").text.split(", "))
        assert {n: float(v) for n, v in told.items()} == {
            n: float(f"{here[n].item():.4g}") for n in ("stiffness", "damping")
        }
        for name in mc.METRICS.names:
            shown = find(opened, f".readout tr[data-metric='{name}'] td").text
            value = here[name].item()
            if name == "diverged":
                assert shown == ("yes" if value else "no")
            elif name == "detached_limb":
                assert shown == here[name].attrs["flag_meanings"].split()[value + 1].replace("none", "-")
            elif np.isnan(value):
                assert shown == "-"
            else:
                assert float(shown) == float(f"{value:.4g}")


@pytest.mark.slow
def test_between_cells_the_map_interpolates_and_says_so(opened, swept):
    """Bilinear in the logarithms of the gains; beside a walk that failed nothing is."""
    grid, shares = swept[1], (0.25, 0.6)  # of the way from the first cell to the next
    places = [find(opened, f".map rect[data-cell='{cell}']").rect for cell in (0, 3, 1)]
    middles = [(rect["x"] + rect["width"] / 2, rect["y"] + rect["height"] / 2) for rect in places]
    x = middles[0][0] + shares[0] * (middles[1][0] - middles[0][0])
    y = middles[0][1] + shares[1] * (middles[2][1] - middles[0][1])
    move = "document.querySelector('.map svg').dispatchEvent(new PointerEvent('pointermove', {clientX: arguments[0] -"
    opened.execute_script(f"{move} scrollX, clientY: arguments[1] - scrollY, bubbles: true}}))", x, y)
    said = find(opened, ".between").text
    four = grid.isel(stiffness=[0, 1], damping=[0, 1])
    if (four["detached_limb"] >= 0).any() or four["diverged"].any():
        assert said.startswith("Between cells, at stiffness") and said.endswith("as a walk beside it failed.")
        return
    weights = np.outer([1 - shares[0], shares[0]], [1 - shares[1], shares[1]])
    values = four["force_variation"].transpose("stiffness", "damping").values.astype(float)
    log = data_of(swept[0])[0]["points"]["scales"]["force_variation"]["log"]
    expected = np.exp((weights * np.log(values)).sum()) if log else (weights * values).sum()
    told = re.fullmatch(
        r"Between cells, interpolated: force variation \[N\] (\S+) at stiffness (\S+), damping (\S+)\.", said
    )
    assert [float(number) for number in told.groups()] == pytest.approx(
        [expected, 1e2 * 10**0.25, 1e1 * 10**0.6], rel=0.01
    )


@pytest.mark.slow
def test_click_draws_the_histories_of_the_cell(opened, swept):
    folder, grid = swept
    data = data_of(folder)[0]
    stretch, count = data["time"]["stretch"], data["time"]["count"]
    before = find(opened, ".chart path[data-series=cell]").get_attribute("d")
    point_at(opened, ".map rect[data-cell='2']").click().perform()
    assert find(opened, ".chosen-key").get_attribute("data-cell") == "2"
    for line in data["lines"]:
        chart = f".chart[data-line={line['name']}]"
        path = find(opened, f"{chart} path[data-series=cell]").get_attribute("d")
        assert find(opened, f"{chart} path[data-series=pd]").get_attribute("d") != path
        assert path != before
        drawn = np.array(re.findall(r"[ML]([\d.]+) ([\d.-]+)", path), float)
        stored = grid[line["name"]].isel(stiffness=0, damping=2).values
        time = stretch * (np.arange(count) + 0.5)
        x, y = drawn.T
        assert len(x) == 2 * count
        # pixels are a linear map of the stored numbers, to the tenth of a pixel that is written
        for pixels, values in ((x[:count], time), (y, np.concatenate([stored[1], stored[0, ::-1]]))):
            slope, start = np.polyfit(values, pixels, 1)
            np.testing.assert_allclose(slope * values + start, pixels, atol=0.11)
            assert abs(slope) > 0
    assert opened.get_log("browser") == []


@pytest.mark.slow
def test_what_the_page_stores_is_what_was_computed(swept):
    folder, grid = swept
    data = data_of(folder)[0]
    points = data["points"]
    assert points["stored"] == list(range(9))
    for name, (_, _, metric) in LINES.items():
        stored = unpacked(points["histories"][name]).reshape(3, 3, 2, -1)
        np.testing.assert_array_equal(stored, grid[name].transpose("stiffness", "damping", ...))
        # the largest value of a history is the metric, bit by bit
        np.testing.assert_array_equal(stored.max((2, 3)), grid[metric])
    # walks of the table may need a shorter time step than the maps, which the page says
    said = re.search(r"All walks of the table are at a time step of ([\d.e-]+) s", (folder / "report.html").read_text())
    step = {"time_step": float(said[1])} if said else {}
    scenario = mc.load_scenario(folder / "config.yaml")
    walk = mc.rollout(scenario.with_overrides({"control.controller": "pd"} | step))
    stored = next(walk for walk in data["walks"] if walk["name"] == "pd")["lines"]
    for name, values in histories(walk, scenario.steps).items():
        np.testing.assert_allclose(unpacked(stored[name]).reshape(2, -1), values, rtol=1e-6)


@pytest.mark.slow
def test_keys_move_and_choose(opened):
    from selenium.webdriver.common.keys import Keys

    surface = find(opened, ".map svg")
    opened.execute_script("arguments[0].focus()", surface)
    start = int(find(opened, ".readout table").get_attribute("data-cell"))
    across = start + 3 if start < 6 else start - 3
    surface.send_keys(Keys.ARROW_RIGHT if across > start else Keys.ARROW_LEFT)
    assert int(find(opened, ".readout table").get_attribute("data-cell")) == across
    surface.send_keys(Keys.ENTER)
    assert find(opened, ".chosen-key").get_attribute("data-cell") == str(across)


@pytest.mark.slow
def test_the_front_is_what_nothing_beats(opened, swept):
    drawn = [int(cell) for cell in find(opened, ".front svg").get_attribute("data-front").split()]
    flat = swept[1].stack(cell=("stiffness", "damping"), create_index=False)
    held = np.flatnonzero((flat["detached_limb"] < 0) & (flat["diverged"] == 0))
    x, y = (flat[name].values[held] for name in ("base_deviation", "force_variation"))
    assert drawn == held[nondominated(x, y)].tolist()


@pytest.mark.slow
def test_small_windows_and_paper(opened):
    resize(opened, 375, 700)
    assert opened.execute_script("return document.documentElement.scrollWidth") <= 375
    ends = "return [...document.querySelectorAll('.draw svg')].map(e => e.getBoundingClientRect().right)"
    assert max(opened.execute_script(ends)) <= 375
    opened.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    assert not find(opened, "select").is_displayed()
    assert find(opened, ".map svg").is_displayed()
    opened.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})
    pdf = base64.b64decode(opened.execute_cdp_cmd("Page.printToPDF", {"printBackground": True})["data"])
    assert pdf.startswith(b"%PDF") and len(re.findall(rb"/Type\s*/Page\b", pdf)) >= 2


@pytest.fixture(scope="module")
def named(swept):
    """The scenario of the sweep, and its walks under the config's gains and under pd."""
    scenario = mc.load_scenario(swept[0] / "config.yaml")
    six = mc.Gains(*(np.full(6, getattr(scenario.control, name)) for name in ("inertia", "damping", "stiffness")))
    pd = scenario.with_overrides({"control.controller": "pd"})
    return scenario, {"config": mc.rollout(scenario, six), "pd": mc.rollout(pd, six)}


def grid_of(metrics, **gains):
    """A grid over two gains in which every gripper holds."""
    units = {"stiffness": "N/m, N m/rad", "damping": "N s/m, N m s/rad"}
    axes = {name: (name, values, {"units": units[name]}) for name, values in gains.items()}
    shape = [len(values) for values in gains.values()]
    none = {"detached_at": np.full(shape, np.nan), "diverged": np.zeros(shape)}
    data = {name: (list(gains), np.reshape(values, shape)) for name, values in (metrics | none).items()}
    limbs = (list(gains), np.full(shape, -1), {"flag_meanings": "none LF LH RH RF"})
    return xr.Dataset(data | {"detached_limb": limbs}, axes)


def histories_of(grid, lines):
    return grid[["diverged"]].assign({name: ([*grid.dims, "extreme", "stretch"], lines) for name in LINES})


ORIGIN = page.Origin("case", "mjx-climb ask", "mjx-climb again", "duration: 0.3")


def test_the_first_screen_is_a_sentence_five_rows_and_a_picture_and_the_rest_is_folded(tmp_path):
    (tmp_path / "a.png").write_bytes(b"first")
    (tmp_path / "b.png").write_bytes(b"second")
    origin = ORIGIN._replace(pictures={"one": tmp_path / "a.png", "two": tmp_path / "b.png"})
    rows = [[name, "1"] for name in ("stiffness", *reversed(page.MAIN), "travel", page.MAIN[0])]
    every = page.Table("every number", ["metric", "value"], [("", rows[:2]), ("", rows[2:])])
    made = page.Page(
        "", page.Findings("it won", ["warning: it breaks"], ["it is so"]), mc.Scenario(), tables=[every], origin=origin
    )
    open_part, *folded = page.render(made).split('<details class="part">')
    assert re.findall("<li>(.*)</li>", open_part) == ["Warning: it breaks."]
    assert '<p class="verdict">It won.</p>' in open_part
    assert re.findall("<li>(.*)</li>", folded[0]) == ["It is so."]
    assert re.findall(r'<th scope="row" class="word">(.*)</th>', open_part) == [*page.MAIN[: page.ROWS]]
    assert re.findall("<figcaption>(.*)</figcaption>", open_part) == ["one"]
    assert re.findall(r'<th scope="row" class="word">(.*)</th>', folded[1]) == [row[0] for row in rows]
    assert re.findall("<figcaption>(.*)</figcaption>", folded[2]) == ["two"]
    plain = dataclasses.replace(made, tables=[every._replace(sections=[("", [[f"gain {n}", ""] for n in range(9)])])])
    assert [row[0] for row in plain.brief.sections[0][1]] == [f"gain {n}" for n in range(page.ROWS)]
    assert dataclasses.replace(made, tables=[]).brief is None


def rows_of(made):
    """Return the rows of each section of a table, by column."""
    return [[dict(zip(made.columns, row, strict=True)) for row in rows] for _, rows in made.sections]


def test_each_column_holds_the_walk_that_its_header_names():
    """Of the walks side by side: values, changes against each of the others, and gains; the same of a fresh draw."""
    values = {"best": 2.0, "config": 4.0, "pd": 8.0}
    compared = {name: ({"stiffness": 10 * v}, {"force_variation": v}) for name, v in values.items()}
    (gains,), (metrics,) = rows_of(comparison.table(compared, ""))
    told = {"best": "2", "vs config %": "-50.0", "vs pd %": "-75.0", "config": "4", "pd": "8"}
    assert metrics == {"metric": "force variation", "unit": "N", **told}
    changes = dict.fromkeys(("vs config %", "vs pd %"), "")
    assert gains == {"metric": "stiffness", "unit": "N/m", "best": "20", "config": "40", "pd": "80", **changes}

    scores = np.array([[2.0, 3.0], [4.0, 5.0], [8.0, 9.0]])
    data = {name: (("gains", "statistic"), scores) for name in SHOWN} | {"objective": ("gains", scores[:, 0])}
    summed = xr.Dataset(data, {"gains": [*values], "statistic": ["mean", "worst"]}, {"worst_share": 0.2})
    (score,), (variation, worst), *_ = rows_of(judge.judged_table(summed))
    del told["vs pd %"]
    assert score == {"metric": "objective", "unit": "", "of the members": "mean and worst", **told}
    assert variation == {"metric": "force variation", "unit": "N", "of the members": "mean", **told}
    assert [worst[name] for name in (*values, "vs config %")] == ["3", "5", "9", "-40.0"]


CHECKED = verification.Verification(
    metrics={}, value=0.9, search_value=0.9, broken_limits=[], binding_limits=[], less={"damping": None},
    more={"damping": 0.02}, shape={"damping": "cliff"}, slopes={"damping": 0.1}, grid_value=None,
    grid_gains=None, spectral_radius=0.99, margins={}, warnings=[],
)  # fmt: skip


@pytest.fixture
def tuned_page(named):
    """Return what makes the page of a search whose result walks as the config does, beside a map or none."""
    scenario, walks = named
    walks, gains = {"tuned": walks["config"], **walks}, {"inertia": 1.0, "damping": 1e2, "stiffness": 1e3}
    rows = {name: (None if name == "pd" else gains, mc.metrics(walk)) for name, walk in walks.items()}
    point = {"value": 0.9, "penalty": 0.0, "feasible": True, "env_steps": 1000, "phase": "descent"}
    data = xr.Dataset({name: ("point", [value]) for name, value in point.items()})

    def made(over, **changed):
        compared = TuneComparison(walks, over, None, CHECKED, rows, {}, None, "")
        found = tuned.Tuned(data, Problem(scenario), gains=mc.Gains(**gains | changed))
        return tune.page_of(found, compared, page.Findings("0.9 of pd")).at(ORIGIN)

    return made


@pytest.fixture
def over(swept):
    """A map of an objective, its limit of stability between the cells."""
    grid = swept[1]
    radius = 1 + 1e-4 * (np.log10(grid["stiffness"]) - 3.1) + 0 * grid["damping"]
    scores = grid["force_variation"] / grid["force_variation"].mean()
    return grid.assign(objective=scores, feasible=scores < 2, spectral_radius=radius)


@pytest.mark.slow
def test_the_page_of_a_search(tuned_page, over):
    for grid in (None, over):
        made = tuned_page(grid)
        text = page.render(made)
        for words in ("0.9 of pd.", "breaks a limit", "mjx-climb again"):
            assert words in text
        (cells,) = made.explorers.values()
        assert [walk["name"] for walk in cells["walks"]] == ["pd", "config", "tuned"]
        assert (cells["points"] is None) == (grid is None)
    points = cells["points"]
    assert points["begin"] == int(np.argmin(over["objective"].values))
    assert {"objective", "feasible"} < set(points["values"])
    assert cells["opens_on"] == "tuned"
    assert {round(np.log10(x), 6) for x, _ in points["limit"][0]} == {3.1}
    assert next(walk["metrics"] for walk in cells["walks"] if walk["name"] == "tuned")["objective"] == 0.9
    (apart,) = tuned_page(over, stiffness=np.array([1e3, 2e3, 4e3, 10.0, 20.0, 40.0])).explorers.values()
    stands = {mark["name"]: mark["at"] for mark in apart["points"]["marks"]}
    assert stands["tuned, translations"] == pytest.approx([2e3, 1e2])
    assert stands["tuned, rotations"] == pytest.approx([20.0, 1e2]) and "tuned" not in stands


@pytest.mark.slow
def test_the_page_of_a_search_opens_on_its_result(chromium, tuned_page, over, tmp_path):
    chromium.get(page.write(tuned_page(over), tmp_path).as_uri())
    assert find(chromium, ".readout caption").text == "tuned"
    assert find(chromium, ".readout tr[data-metric='objective'] td").text == "0.9"
    assert not chromium.find_elements("css selector", ".chart path[data-series=cell]")
    point_at(chromium, ".map rect[data-cell='2']").click().perform()
    assert find(chromium, ".readout table").get_attribute("data-cell") == "2"
    assert chromium.find_elements("css selector", ".chart path[data-series=cell]")
    assert chromium.get_log("browser") == []


@pytest.mark.slow
@pytest.mark.parametrize("held", [True, False])
def test_the_page_of_a_sweep_begins_with_its_verdict_and_folds_what_else_was_found(held):
    failures = {"detached_limb": None, "diverged": False, "min_tsm": 0.1, "missed_grips": 0}
    values = {"best": (40.0, 0.02), "pd": (80.0, 0.01)} if held else {"pd": (80.0, 0.01)}
    rows = {name: (None, {"force_variation": v, "base_deviation": d, **failures}) for name, (v, d) in values.items()}
    grid = grid_of({"force_variation": np.zeros(4)}, stiffness=[1e2, 1e3], damping=[1.0, 2.0])
    grid = grid.assign_attrs(dtype="float32", engine="limb", batch_size=4)
    best = grid.isel(stiffness=1, damping=0) if held else None
    scenario = mc.Scenario().with_overrides({"duration": 0.3, "control.controller": "pd"})
    walks = dict.fromkeys(rows, mc.rollout(scenario))
    lines = histories_of(grid.isel(damping=[1]), np.zeros((2, 1, 2, 2)))
    compared = SweepComparison(
        grid, best, walks, rows, 1, ["damping"], None, "the verdict", AtOneStep(5e-4, np.nan), lines
    )
    made = sweep.contents(Swept(grid, Problem(scenario)), compared, "").page(ORIGIN)
    alone = "Walks alone, in double precision; the map is in single precision, where the best has 0 N"
    expected = (
        [alone, "1 of 4 walks lost a gripper or diverged", "worse than pd: base deviation +100 %"] if held else []
    )
    cells = "the page holds the time histories of 2 of the cells; a click shows the nearest of them"
    step = "retuned_pd walks at a time step of 0.0005 s, which its kp and kd need"
    warning = "warning: the best lies on the edge of the grid: widen damping"
    assert made.findings == page.Findings("the verdict", [warning], [*expected, step, cells])
    if held:
        assert made.explorers["Maps and walks"]["points"]["begin"] == 2


@pytest.mark.slow
def test_the_page_of_a_front(swept, named):
    flat = swept[1].stack(front=("stiffness", "damping"), create_index=False)
    six = {name: ("front", flat[name].values) for name in ("stiffness", "damping")}
    front = flat[list(mc.METRICS.names)].drop_vars(["stiffness", "damping"]).assign(six)
    traded = ("base_deviation", "force_variation")
    references = {f"reference_{name}": ("reference", [0.1, 0.2]) for name in traded}
    front = front.assign(references).assign_coords(reference=["config", "pd"])
    front = front.assign_attrs(better=traded[1], against=traded[0], searched="stiffness damping")
    bend = fronts.knee(*(front[name].values for name in traded))
    knee = front[traded[0]].values[bend]
    without = {f"without_{traded[0]}": [0.5 * knee, 2 * knee], f"without_{traded[1]}": [7.0, 5.0]}
    without |= {"without_kp": [30.0, 10.0], "without_kd": [0.5, 0.25]}
    front = front.assign({name: ("without", np.array(values)) for name, values in without.items()})
    kept = {name: flat[name].transpose("front", ...).values for name in LINES}
    found = Front(front, Problem(named[0]))
    metrics = {name: mc.metrics(walk) for name, walk in named[1].items()}
    compared = FrontComparison(named[1], metrics, kept, of_front(found), verdict(found, metrics))
    made = pareto.page_of(found, compared)
    assert made.findings.verdict.startswith("the front of 9 points bends at")
    assert "% above pd with its own kp and kd searched" in made.findings.verdict
    assert compared.worth.endswith(", at no more base deviation")
    (_, on), (_, below) = made.tables[0].sections
    assert [row[0] for row in on] == ["knee" if i == bend else "" for i in range(9)] and len(on[0]) == 5
    assert [row[0] for row in below] == ["config", "pd", "retuned_pd, kp 30, kd 0.5"]
    points = made.explorers["The front"]["points"]
    assert points["trade"] == ["base_deviation", "force_variation"] and points["begin"] == bend


def test_folders_of_a_machine_are_left_out():
    for text, expected in (
        ("/home/me/configs/c.yaml", "c.yaml"),
        ("robot: /a b/c d/r.xml", "robot: r.xml"),
        ("robot: /a/b/r.xml\nspeed: 1 m/s", "robot: r.xml\nspeed: 1 m/s"),
        ("~/runs/a.yaml", "a.yaml"),
        ("configs/case_2.yaml", "configs/case_2.yaml"),
        ("1e2:1e6:12", "1e2:1e6:12"),
    ):
        assert without_folders(text) == expected


def test_cells_of_a_grid_that_is_not_square():
    """Histories of one row only; gains in the order of the cells, in the unit of translations."""
    grid = grid_of({"peak_foot_force": np.arange(6.0)}, stiffness=[1e2, 1e3, 1e4], damping=[1e1, 1e2])
    lines = np.arange(24.0).reshape(3, 2, 2, 2)
    lines[2, 1, 0] = np.nan, np.inf  # a walk that diverges
    points = explorer.grid_points(grid, histories_of(grid, lines).isel(damping=[1]), {}, {}, None)
    assert points["stored"] == [1, 3, 5] and points["values"]["peak_foot_force"] == list(range(6))
    assert points["gains"] == {"stiffness": [1e2, 1e2, 1e3, 1e3, 1e4, 1e4], "damping": [1e1, 1e2] * 3}
    assert [axis["unit"] for axis in points["axes"]] == ["N/m", "N s/m"]
    np.testing.assert_array_equal(unpacked(points["histories"]["foot_force_history"]), lines[:, 1].ravel())


def test_a_coarser_grid_keeps_what_it_must():
    grid = grid_of({}, stiffness=np.arange(48), damping=np.arange(5))
    rows = explorer.coarser_grid(grid, grid.isel(stiffness=31, damping=4), 100).coords
    assert len(rows["stiffness"]) * len(rows["damping"]) <= 100
    assert 31 in rows["stiffness"] and 4 in rows["damping"]
    assert rows["stiffness"][0] == 0 and rows["stiffness"][-1] == 47
    assert (np.diff(rows["stiffness"]) > 0).all()


def test_what_failed_says_so_and_nothing_is_compared_with_it():
    """A robot that lost a grip and still stands has numbers; what flew off or diverged has none that mean anything."""
    held = {"force_variation": 50.0, "base_deviation": 0.001, "detached_at": None, "detached_limb": None}
    torn = {"force_variation": 80.0, "base_deviation": 0.2, "detached_at": 0.06, "detached_limb": "LF"}
    flown = torn | {"force_variation": 3.928e86, "base_deviation": 1e12}
    diverged = held | {"force_variation": 7.0, "diverged": True}
    walks = {name: {"diverged": False, **own} for name, own in
             {"best": held, "torn": torn, "flown": flown, "gone": diverged}.items()}  # fmt: skip
    made = comparison.table({name: (None, own) for name, own in walks.items()}, "")
    _, (gone, variation, _, at, limb) = rows_of(made)
    assert [variation[name] for name in walks] == ["50", "80", "failed", "failed"]
    assert {variation[f"vs {name} %"] for name in ("torn", "flown", "gone")} == {""}
    assert [limb[name] for name in walks] == ["-", "LF", "LF", "-"]
    assert (at["flown"], gone["gone"]) == ("0.06", "yes")
    assert verdicts.against("force_variation", "best", walks) == "50 N"
    assert differences(held, torn) == ([], [])
    assert differences(held | {"force_variation": 60.0}, held)[0]


def test_words_say_which_way_metrics_went():
    forces = {name: {"peak_foot_force": force} for name, force in {"best": 3.0, "pd": 4.0, "paper": None}.items()}
    assert verdicts.against("peak_foot_force", "best", forces) == "3 N, 25.0 % below pd as the config has it"
    metrics, baseline = {"force_variation": 1.0, "base_deviation": 2.0}, {"force_variation": 2.0, "base_deviation": 1.0}
    worse, better = differences(metrics, baseline)
    assert (worse, better) == (["base deviation +100 %"], ["force variation -50.0 %"])
    assert differences(metrics, baseline, but=("force_variation",)) == (worse, [])


@pytest.mark.parametrize(
    ("name", "value", "base", "worse", "better"),
    [
        ("peak_pull_force", 1.021, 1.0, ["peak pull force +2.1 %"], []),
        ("peak_pull_force", 1.019, 1.0, [], []),
        ("min_gia_margin", 0.979, 1.0, ["min GIA margin -2.1 %"], []),
        ("min_tsm", 0.5, 1.0, ["min TSM -50.0 %"], []),
        ("min_gia_margin", -2.0, -1.0, ["min GIA margin -1 to -2"], []),  # no per cent of what is negative, or nothing
        ("min_gia_margin", -1.0, -2.0, [], ["min GIA margin -2 to -1"]),
        ("missed_grips", 3, 0, ["missed grips 0 to 3"], []),
        ("missed_grips", 0, 0, [], []),
        ("detached_at", None, 1.0, [], []),
        ("diverged", True, False, [], []),
    ],
)
def test_whatever_differs_by_more_than_two_per_cent_is_named(name, value, base, worse, better):
    assert differences({name: value}, {name: base}) == (worse, better)


def test_of_rounds_of_many_points_the_best_is_drawn():
    many, few = tune.CROWD + 1, 3
    rounds = np.repeat([0, 1, 2, 3], [few, many, many, many])
    value, penalty = np.full(rounds.size, 2.0), np.zeros(rounds.size)
    value[few + 5], value[few + many + 7], value[few + many + 8] = 1.0, 0.5, np.nan
    value[-many:] = np.nan  # nobody walked to the end
    value[few + 6], penalty[few + 6] = 0.1, 9.0  # beyond a limit
    history = xr.Dataset({"round": ("point", rounds), "value": ("point", value), "penalty": ("point", penalty)})
    # so that the map below is seen
    assert tune.best_of_crowds(history).tolist() == [few + 5, few + many + 7]
    assert tune.crowded(history).tolist() == [False] * few + [True] * 3 * many
    few_points = history.isel(point=slice(0, few))
    assert not tune.best_of_crowds(few_points).size and not tune.crowded(few_points).any()


JUMPY, MEASURED = {"gait.swing": "low_reaction"}, {"control.reading": "measured_pose"}
UNSTUCK, OF_STEP = "contact.capture_distance", "0.0005 s, without a hardware.control_period"


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, None),
        (JUMPY, UNSTUCK),
        (JUMPY | {"contact.capture_distance": 0.005}, None),
        (JUMPY | {"gravity": [0.0, 0.0, 0.0]}, None),
        (MEASURED | {"time_step": 5e-4}, OF_STEP),
        (MEASURED | {"time_step": 5e-4, "hardware.control_period": 1e-3}, None),
        (MEASURED, None),
        ({"time_step": 5e-4}, None),
    ],
)
def test_what_speaks_against_a_scenario_is_said_before_the_walk(changes, said):
    """A low-reaction swing under weight where grippers hold at any distance, and gains of another control period.

    Case 1.1, the paper's gains: COT 1.31 at 1 ms, 5.03 at 0.5 ms, 1.31 there with a period of 1 ms.
    """
    lines = numbers.ahead_of(mc.load_scenario("case_1_1", changes))
    assert len(lines) == (said is not None) and all(said in line for line in lines)


def test_a_difference_of_too_few_walks_has_no_interval():
    numbers = {
        "value": [[4.5, 5.0], [5.0, 5.0]], "difference": [[-0.5, 0.0], [0.25, 0.0]], "real": [[False, False]] * 2,
        "low": [[-1.0, 0.0], [np.nan, 0.0]], "high": [[0.25, 0.0], [np.nan, 0.0]],
    }  # fmt: skip
    names = {"metric": ["force_variation"], "statistic": ["mean", "worst"], "gains": ["mine", "retuned_pd"]}
    about = {"baseline": "retuned_pd", "worst_share": 0.05, "members_compared": 4}
    table = xr.Dataset({name: (tuple(names), [each]) for name, each in numbers.items()}, names, about)
    [(_, [own, _])] = laws.laws_table(table).sections
    assert own == ["force variation N", "mine", "4.5", "-10.0 [-20.0, 5.0]~", "5", "+5.0 [no interval]~"]


def test_the_first_screen_shows_every_law_and_every_statistic():
    """A row without a name belongs to the metric above it; rows of one name stay together."""
    rows = [[("force variation N", "", "")[place], law, "1"] for place, law in enumerate(("mine", "other", "pd"))]
    more = [["objective", "mine", "2"], ["", "other", "3"]]
    laws = page.Table("", ["metric", "law", "mean"], [("", rows), ("", more)])
    made = page.Page("", page.Findings(""), mc.Scenario(), origin=ORIGIN, tables=[laws], main=["objective", rows[0][0]])
    assert made.brief.sections == [("", more + rows)]
    means = [["force variation", "mean"], ["force variation", "worst 5%"], ["travel", "mean"]]
    both = dataclasses.replace(made, tables=[page.Table("", ["", ""], [("", means)])], main=page.MAIN)
    assert both.brief.sections == [("", means[:2])]


def test_the_first_screen_takes_rows_without_a_name():
    """As those of a front: its points have none."""
    table = page.Table("", ["", "N"], [("", [["", "1"], ["", "2"], ["pd", "3"]])], 1)
    said = page.Findings("", [], [])
    made = page.Page("", said, mc.Scenario(), origin=ORIGIN, tables=[table])
    assert made.brief.sections == [("", [["", "1"], ["", "2"], ["pd", "3"]])]


def test_a_terminal_ends_with_what_a_page_begins_with():
    said = page.Findings.of("it won", ["a note", "warning: on a bound"], "the sensor does not pay", "")
    assert said.lines == ["a note", "the sensor does not pay", "warning: on a bound", "it won"]
    made = page.render(page.Page("", said, mc.Scenario(), origin=ORIGIN))
    places = [
        made.index(f"{words}.<") for words in ("It won", "The sensor does not pay", "Warning: on a bound", "A note")
    ]
    assert places == sorted(places) and made[: places[-1]].count("<details") == 1


@pytest.mark.parametrize("terminal", [False, True])
def test_no_number_of_a_table_is_cut(terminal):
    """Of a table of laws a file of 100 columns had "+18.1 [no inter"."""
    cells = [f"{18.1 + place:+.1f} [no interval]~" for place in range(6)]
    names = [f"a_law_of_a_long_name_{place}" for place in range(6)]
    made = page.Table("", ["metric", "law", *names], [("", [["force variation N", "end_effector_admittance", *cells]])])
    file = io.StringIO()
    file.isatty = lambda: terminal
    shell = Session(file)
    shell.show(made)
    assert all(cell in file.getvalue() for cell in cells)
