"""What options name as FILE.py:NAME: metrics of the user's own."""

import re

import pytest

import mjx_climb as mc
from tuning.problem import own_file

TEXT = """
from mjx_climb.walk.metrics import peak

speed = peak("peak_base_speed", "m/s", "largest speed of the base", lambda s, _: abs(s.base_linear_velocity))
taken = peak("travel", "m", "another travel", lambda s, _: s.base_position)
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(TEXT)
    return path


def test_metrics_stand_behind_the_shipped_ones(file):
    table = own_file.metrics([f"{file}:speed"])
    assert table.names == (*mc.METRICS.names, "peak_base_speed")
    assert own_file.metrics([]) == mc.METRICS


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("missing", "expected a metric named missing, got none"),
        ("peak", "expected peak to be a metric, as of mjx_climb.Metric, got <function peak"),
        ("taken", "taken: metric travel: expected one of this name, got two"),
    ],
)
def test_what_is_no_metric_is_refused_in_one_line(file, name, said):
    with pytest.raises(mc.ConfigError, match=re.escape(f"{file}: {said}")) as refused:
        own_file.metrics([f"{file}:{name}"])
    assert "\n" not in str(refused.value)
