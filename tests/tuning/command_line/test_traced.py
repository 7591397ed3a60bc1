"""A stage says when its large program is traced, or loaded: small programs on the way say nothing."""

import pytest

from tuning.command_line import session


@pytest.mark.parametrize(
    ("events", "told"),
    [
        ([(session.COMPILED, 0.2), (session.LOWERED, 0.01)], 0),  # a helper that the processor was slow with
        ([(session.LOWERED, 3.0), (session.COMPILED, 9.0)], 1),
        ([(session.FROM_CACHE, None), (session.COMPILED, 0.4)], 1),
        ([(session.FROM_CACHE, None), (session.COMPILED, 0.01)], 0),
    ],
)
def test_a_program_that_is_traced_or_loaded_is_told(events, told):
    from jax import monitoring

    seen = []
    with session.Compilation(traced=lambda: seen.append(1)):
        for event, seconds in events:
            if seconds is None:
                monitoring.record_event(event)
            else:
                monitoring.record_event_duration_secs(event, seconds)
    assert len(seen) == told
