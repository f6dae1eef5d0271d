"""Settings of a fit: fields by name, refused where unknown."""

import dataclasses

import pytest

import opfem as op


def test_settings_are_changed_by_name():
    settings = op.FitSettings(draws=4).changed(rtol=1e-3)
    assert (settings.draws, settings.rtol) == (4, 1e-3)
    assert settings.max_steps == op.FitSettings().max_steps


def test_unknown_setting_is_refused_with_those_there_are():
    with pytest.raises(TypeError, match=r"unknown argument 'max_step'.*max_steps"):
        op.FitSettings().changed(max_step=3)


def test_every_setting_is_documented():
    documented = op.FitSettings.__doc__ or ""
    assert [field.name for field in dataclasses.fields(op.FitSettings) if f"{field.name}: " not in documented] == []
