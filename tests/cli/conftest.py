"""Commands, whose pictures nobody looks at here."""

import pytest


@pytest.fixture(autouse=True)
def _rough_pictures(rough_layout):
    """Labels are placed once: where they are is a question of `tests/plot`."""
