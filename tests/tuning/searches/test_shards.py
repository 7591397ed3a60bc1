"""Shards: cut, kept, taken up again, put together bit by bit, and refused where they do not belong together."""

import dataclasses
import shutil

import numpy as np
import pytest
import xarray as xr

import mjx_climb as mc
import tuning
from mjx_climb.execution import devices
from mjx_climb.files.dataset import OutputError
from mjx_climb.scenario.shipped import config_path
from tuning.methods import parts
from tuning.searches import shards
from tuning.searches.shards import Rows, Shard

AXES = {"stiffness": np.array([1e3, 1e4, 1e5]), "damping": np.array([1e2, 1e3])}
SIZE = 4


@dataclasses.dataclass(frozen=True)
class Numbers:
    """Work that walks nothing: a row's value depends on the row alone."""

    rows: int = 10
    size: int = SIZE
    settings: float = 1.0
    platform: str = "cpu"

    def identity(self):
        return {"kind": "test", "settings": {"a": self.settings, "b": 2.0}, "platform": self.platform}

    def walk(self, rows):
        assert rows.min() >= 0 and rows.max() < self.rows
        return {"x": np.sin(rows * self.settings)}

    def name(self, row):
        return f"row {row}"

    def write_asked(self, folder):
        (folder / "asked").write_text("")


def keep(work, out, shard, lose=()):
    """Walk a shard into its folder, and lose some of its parts again."""
    Rows(work, out, (shard.number, shard.count), {"again": "walk it --shard {shard}"}).walk()
    for number in lose:
        (shard.folder(out) / parts.FOLDER / f"part-{number:06d}.npz").unlink()


@pytest.fixture
def three(tmp_path):
    for number in (1, 2, 3):
        keep(Numbers(), tmp_path, Shard(number, 3))
    return tmp_path


@pytest.mark.parametrize(("rows", "count"), [(10, 1), (10, 3), (10, 10), (97, 16)])
def test_shards_hold_every_row_once(rows, count):
    cut = [Shard(number, count).rows(rows) for number in range(1, count + 1)]
    assert [row for part in cut for row in part] == list(range(rows))
    assert max(map(len, cut)) - min(map(len, cut)) <= 1


def test_shards_joined_are_the_whole(three):
    whole = Rows(Numbers()).walk()
    np.testing.assert_array_equal(whole["x"], np.sin(np.arange(10.0)))
    for folders in ([three], list(reversed([Shard(n, 3).folder(three) for n in (1, 2, 3)]))):
        for platform in ("cpu", "gpu"):  # of the machine that joins them
            joined = shards.joined(Numbers(platform=platform), shards.find(folders))
            assert joined["x"].tobytes() == whole["x"].tobytes()


@pytest.mark.parametrize("in_regions", [True, False])
@pytest.mark.parametrize("whole", [1, 5, 40, 72, 150, 500])
def test_robots_keep_place_and_program(whole, in_regions, cpu_alone):
    """They walk in whole shares that begin where those of the whole batch do, by the same program."""
    share = devices.share_size(whole, None, in_regions=in_regions)
    for start in range(0, whole, 7):
        robots = range(start, min(start + 11, whole))
        walking = devices.walking_with(robots, whole, in_regions=in_regions)
        assert walking.start % share == 0 and set(robots) <= set(walking)
        assert devices.share_size(len(walking), None, in_regions=in_regions) == share


def test_a_shard_goes_on_where_it_stopped(tmp_path):
    shard, seen = Shard(2, 2), []
    keep(Numbers(), tmp_path, shard, lose=[1])
    own = Rows(Numbers(), tmp_path, (2, 2))
    assert own.there == 3  # of rows 5 to 7, and 8 and 9 after them
    own.walk(lambda *done: seen.append(done))
    assert seen == [(3, 5), (5, 5)]


def test_what_died_is_named_with_what_finishes_it(three):
    shutil.rmtree(Shard(3, 3).folder(three))
    keep(Numbers(), three, Shard(2, 3), lose=[1])
    with pytest.raises(mc.ConfigError) as refused:
        shards.joined(Numbers(), shards.find([three]))
    said = str(refused.value)
    assert said.startswith(f"{three}: shard 2/3 lacks 2 of 3 walks (row 4 to row 5); ")
    assert "shard 3/3 is not there: it lacks 4 of 4 walks (row 6 to row 9)" in said
    assert said.endswith("to finish it: walk it --shard 2/3, and likewise 3/3")


def test_shards_that_do_not_belong_together(three, tmp_path_factory):
    other = tmp_path_factory.mktemp("other")
    keep(Numbers(settings=2.0), other, Shard(1, 3))
    first, second = Shard(1, 3).folder(three), Shard(2, 3).folder(three)
    for folders, expected in (
        ([other, second], f"{second}: expected a shard of the same as .*, got one that differs in settings.a$"),
        ([first, first], f"expected each shard once, got 1/3 in {first} as well$"),
        ([three, second], "expected each shard once, got 2/3"),
        ([three / "nowhere"], "nowhere: expected a shard's folder, or one that holds shards, got none"),
    ):
        with pytest.raises(mc.ConfigError, match=expected):
            shards.find(folders)
    with pytest.raises(mc.ConfigError, match=r"differs in settings\.a$"):
        shards.joined(Numbers(settings=3.0), shards.find([three]))
    keep(Numbers(), other / "halves", Shard(1, 2))
    with pytest.raises(mc.ConfigError, match=r"expected a shard of 3 as .*, got 1/2"):
        shards.find([three, other / "halves"])
    (first / shards.FILE).write_text("{")
    with pytest.raises(mc.ConfigError, match=f"{first}: expected the folder of a shard"):
        shards.find([three])


def test_a_folder_takes_shards_of_one_thing(three):
    with pytest.raises(OutputError, match="expected shards of 2, got shard-1-of-3"):
        Rows(Numbers(), three, (1, 2))
    with pytest.raises(OutputError, match=r"differs in settings\.a "):
        Rows(Numbers(settings=2.0), three, (1, 3))
    with pytest.raises(mc.ConfigError, match="expected at most 10 shards"):
        Rows(Numbers(), three / "new", (1, 11))


@pytest.fixture(scope="module")
def scenario():
    return mc.load_scenario(config_path("case_1_2.yaml"), ["duration=0.3"])


@pytest.mark.slow
def test_a_sweep_in_shards_is_the_sweep(scenario, tmp_path):
    """Every array and attribute; the law's inertia, given as further gains, comes back from the shards too."""
    gains = mc.Gains(2.0, 1e2, 1e3)
    for number in (1, 2, 3):
        tuning.sweep_shard(scenario, AXES, (number, 3), gains=gains, batch_size=SIZE, out=tmp_path)
    merged = tuning.merge([tmp_path])
    whole = tuning.sweep(scenario, AXES, gains=gains, batch_size=SIZE)
    xr.testing.assert_identical(merged.data, whole.data)
    assert (merged.scenario, merged.problem.engine) == (whole.scenario, whole.problem.engine)
    assert merged.gains.inertia == 2.0
    (Shard(2, 3).folder(tmp_path) / parts.FOLDER / "part-000000.npz").unlink()
    with pytest.raises(mc.ConfigError, match=r"shard 2/3 lacks 2 of 2 walks \(stiffness 1e\+04 damping 100 to "):
        tuning.merge([tmp_path])
