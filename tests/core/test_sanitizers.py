"""The kernels under sanitizers, on the driver's odd inputs; ThreadSanitizer runs in ``make check-native``."""

from __future__ import annotations

import pytest

from tests.native import sanitize


def test_the_kernels_are_clean_under_address_and_undefined_behaviour_sanitizers() -> None:
    reason = sanitize.supported("address")
    if reason:
        pytest.skip(reason)
    done = sanitize.run("address")
    assert done.returncode == 0, done.stderr
    assert "same bits" in done.stdout
