from __future__ import annotations

from importlib.resources import files


def test_the_package_says_that_it_is_typed():
    assert (files("psiamfcpp") / "py.typed").is_file(), "without it mypy takes every type of the package for Any"
