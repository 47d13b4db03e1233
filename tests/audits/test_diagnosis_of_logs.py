"""The audit of diagnoses, on a part of its logs."""

import pytest
from diagnosis import main

pytestmark = pytest.mark.slow


def test_faults_are_named_first_and_clean_logs_are_not_accused():
    right, accused, covered = main(40, seed=1)
    assert right >= 0.9 and accused <= 1 and 0.88 <= covered <= 1.0
