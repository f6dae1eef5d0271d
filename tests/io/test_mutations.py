"""Mutated files of every format: a sample of what `benchmarks/mutated_inputs.py` does by the thousand."""

import numpy as np
import pytest

import opfem as op
from benchmarks.mutated_inputs import BAD, EXTENT, FORMATS, OUTCOMES, judge, mutant, read_map, true_map

OF_EACH = 8


@pytest.mark.parametrize("number", range(OF_EACH))
@pytest.mark.parametrize("name", FORMATS)
def test_ends_in_a_map_a_warning_or_one_line(name, number):
    verdict = judge(name, number)
    assert verdict.outcome in OUTCOMES
    assert verdict.outcome not in BAD, verdict.said


def test_mutants_are_made_again(tmp_path):
    made = [mutant("csv", 3, tmp_path).read_bytes() for _ in range(2)]
    assert made[0] == made[1]
    assert mutant("csv", 4, tmp_path).read_bytes() != made[0]


class TestVerdicts:
    def verdict(self, folder, monkeypatch, read):
        monkeypatch.setattr(op, "read_thickness", read)
        return read_map(folder / "a.npy").outcome

    def given(self, values):
        return lambda path, extent: op.ThicknessMap(values, extent=extent)

    def test_good_maps(self, tmp_path, monkeypatch):
        assert self.verdict(tmp_path, monkeypatch, self.given(true_map())) == "right"
        assert self.verdict(tmp_path, monkeypatch, self.given(true_map() + 0.01)) == "numbers"

    def test_bad_readers(self, tmp_path, monkeypatch):
        def raises(path, extent):
            raise KeyError(path)

        def several_lines(path, extent):
            raise op.MeasurementError("first\nsecond")

        assert self.verdict(tmp_path, monkeypatch, self.given(true_map()[:-1])) == "grid"
        assert self.verdict(tmp_path, monkeypatch, raises) == "traceback"
        assert self.verdict(tmp_path, monkeypatch, several_lines) == "traceback"

    def test_whole_files_are_right(self, tmp_path):
        for name, (suffix, write) in FORMATS.items():
            if name != "toml":
                for seed in range(6):
                    write(tmp_path / f"whole{suffix}", np.random.default_rng(seed))
                    assert read_map(tmp_path / f"whole{suffix}").outcome == "right", name
        assert EXTENT[0] / 29 == pytest.approx(EXTENT[1] / 19)
