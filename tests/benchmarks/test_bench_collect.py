"""The benchmark of collection on the smallest scale: it runs, and its figures are consistent."""

from __future__ import annotations

import json

import pytest
from click.testing import CliRunner

from benchmarks.bench_collect import main


@pytest.mark.slow
def test_speed_and_bytes(built):
    arguments = ["speed", "bytes", "--profile", str(built / "tiny.toml"), "--updates", "3", "--streams", "1"]
    result = CliRunner().invoke(main, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    speed, size = (json.loads(line) for line in result.output.splitlines())
    assert speed["recorded_transitions_per_second"] > 0
    assert 0 < speed["recording_and_writing_share"] < 1
    assert size["paper_bytes_per_transition"] > size["full_bytes_per_transition"] > size["lite_bytes_per_transition"]
