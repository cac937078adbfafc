import numpy as np
import pytest

from apt_evap._common.label_places import end_of_line, place_above, place_labels


def overlaps(a, b):
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def test_the_first_free_option_is_taken():
    here, there = [(0, 0, 10, 10)], [(20, 0, 30, 10)]
    beyond = [(95, 0, 105, 10)]
    placed = place_labels([[here, there], [here, there], [here, there], [beyond]], (0, 0, 100, 100))
    assert placed == [here, there, None, None]
    assert place_labels([[here, there]], (0, 0, 100, 100), taken=[(9, 9, 12, 12)]) == [there]
    assert place_labels([], (0, 0, 1, 1)) == []


@pytest.mark.parametrize("seed", range(5))
def test_labels_of_peaks_hide_neither_the_curve_nor_each_other(seed):
    rng = np.random.default_rng(seed)
    area = 0.0, 0.0, 700.0, 300.0
    x = rng.choice(700, 40, replace=False) + 0.5
    heights = np.sort(rng.uniform(5, 200, 40))[::-1]
    curve = np.full(700, 3.0)
    curve[x.astype(int)] = heights

    def highest(left, right):
        return curve[int(max(left, 0)) : int(right) + 1].max()

    sizes = np.column_stack([rng.uniform(15, 60, 40), np.full(40, 16.0)])
    peaks = np.column_stack([x, heights])
    placed = place_above(peaks, sizes, area, highest, taken=[(600, 200, 700, 300)])
    there = [boxes for boxes in placed if boxes is not None]
    assert 20 < len(there)
    for number, (text, line) in enumerate(there):
        assert text[0] >= 0 and text[2] <= 700 and text[1] >= 0 and text[3] <= 300
        assert text[1] > highest(text[0], text[2])
        assert not overlaps(text, (600, 200, 700, 300))
        for other_text, other_line in there[:number]:
            assert not overlaps(text, other_text)
            assert not overlaps(text, other_line) and not overlaps(line, other_text)
    for peak, boxes in zip(peaks, placed, strict=True):
        if boxes is not None:
            end = end_of_line(peak, boxes[0])
            assert highest(*sorted([peak[0], end[0]])) <= peak[1] + 1


def test_of_labels_without_a_place_the_last_is_left_out():
    sizes = np.full((3, 2), (40.0, 16.0))
    peaks = np.array([[20.0, 5.0], [21.0, 5.0], [22.0, 5.0]])
    # one column of the width of a label, as high as two of them
    placed = place_above(peaks, sizes, (0, 0, 41, 45), lambda left, right: 5.0)
    assert placed[0] is not None and placed[2] is None


def test_a_label_that_would_hide_the_next_peak_stands_aside():
    """Peaks at 1 and 2 Da next to the axis, the second one lower: both have their label."""
    peaks, sizes = np.array([[13.0, 120.0], [26.0, 103.0]]), np.full((2, 2), (35.0, 25.0))
    curve = {13: 120.0, 26: 103.0}

    def highest(left, right):
        return max((y for x, y in curve.items() if left <= x <= right), default=0.0)

    first, second = place_above(peaks, sizes, (0, 0, 700, 300), highest)
    assert first is not None and second is not None and first[0][0] >= 0
    assert not overlaps(first[0], second[0])
