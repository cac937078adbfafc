"""Places of labels in a picture, so that none overlaps another one or what is drawn [pixels]."""

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from apt_evap._common.types import Floats

Box = tuple[float, float, float, float]
"""Left, bottom, right and top."""
_GAP = 3.0  # between a curve and its label
_LINE = 1.0  # half width of the line from a peak to its label
_STEPS = 16  # half heights of a label, by which it rises at most
_TRIES = 40  # orders of the labels
_IN_THE_WAY = 3.0  # heights of a label that its place is worse for each other peak that it hides


def place_labels(
    options: Sequence[Sequence[Sequence[Box]]], area: Box, taken: Iterable[Box] = ()
) -> list[Sequence[Box] | None]:
    """First free option of each label, the most important label first; None for a label without a free one.

    An option is a sequence of boxes that it covers, that of its text first; texts stay in `area`, off the boxes in
    `taken`.
    """
    arrays = [np.array(list(boxes), dtype=float) for boxes in options]  # (options, boxes, 4)
    return _placed(options, arrays, area, np.array(list(taken), dtype=float).reshape(-1, 4))


def _placed(options, arrays, area, covered):
    """The same, of options that are also arrays, and of boxes of what is drawn already as an array."""
    placed = []
    for each, boxes in zip(options, arrays, strict=True):
        placed.append(None)
        if not len(boxes):
            continue
        left, bottom, right, top = boxes[:, 0].T
        free = (left >= area[0]) & (bottom >= area[1]) & (right <= area[2]) & (top <= area[3])
        box, other = boxes[:, :, None], covered
        overlap = (box[..., 0] < other[:, 2]) & (other[:, 0] < box[..., 2])
        overlap &= (box[..., 1] < other[:, 3]) & (other[:, 1] < box[..., 3])
        free &= ~overlap.any(axis=(1, 2))
        if free.any():
            first = int(np.argmax(free))
            covered = np.concatenate([covered, boxes[first]])
            placed[-1] = each[first]
    return placed


def outline(sides: Floats, tops: Floats) -> Callable[[float, float], float]:
    """Function of the highest point of a histogram between two places, of its edges and heights [pixels]."""

    def highest(left: float, right: float) -> float:
        first, last = np.searchsorted(sides, [left, right])
        return float(tops[max(first - 1, 0) : max(last, 1)].max(initial=0.0))

    return highest


def place_above(
    peaks: Floats,
    sizes: Floats,
    area: Box,
    highest: Callable[[float, float], float],
    taken: Iterable[Box] = (),
) -> list[Sequence[Box] | None]:
    """Boxes of the labels of peaks, above a curve: that of the text, and that of a line down to the peak.

    `peaks` are their tops, the most important first, shape (n, 2), `sizes` widths and heights of the labels, shape (n,
    2). `highest` returns the highest point of the curve from the left to the right.
    """
    options = [
        _above(peak, size, np.delete(peaks[:, 0], number), area, highest)
        for number, (peak, size) in enumerate(zip(peaks, sizes, strict=True))
    ]
    arrays, covered = [np.array(boxes) for boxes in options], np.array(list(taken), dtype=float).reshape(-1, 4)
    numbers = list(range(len(options)))
    # labels of near peaks often find places like stairs
    orders = [numbers, sorted(numbers, key=lambda k: -peaks[k, 0]), sorted(numbers, key=lambda k: peaks[k, 0])]
    best: list[Sequence[Box] | None] = []
    for _ in range(_TRIES):
        if not orders:
            break
        order = orders.pop(0)
        in_order = _placed([options[k] for k in order], [arrays[k] for k in order], area, covered)
        placed = [boxes for _, boxes in sorted(zip(order, in_order, strict=True), key=lambda pair: pair[0])]
        if not best or [boxes is not None for boxes in placed] > [boxes is not None for boxes in best]:
            best = placed
            left_out = [k for k in numbers if placed[k] is None]
            if not left_out:
                break
            orders += [[k, *(other for other in order if other != k)] for k in left_out]  # each of them first
    return best


def _above(peak, size, others, area, highest):
    """Options of a label: over its peak, to its right or left, beside it, and higher; the nearest first."""
    (x, y), (width, height) = peak, size
    options = []
    for shift in (-0.5, 0.0, -1.0, 0.5, -1.5):
        left = min(max(x + shift * width, area[0]), area[2] - width)
        hidden = np.count_nonzero((others > left - _LINE) & (others < left + width + _LINE))
        worse = (_IN_THE_WAY * hidden + abs(shift + 0.5)) * height
        lowest = max(highest(left, left + width), y) + _GAP
        for bottom in lowest + 0.5 * height * np.arange(_STEPS):
            text = left, bottom, left + width, bottom + height
            end = end_of_line((x, y), text)[0]
            if end != x and highest(min(x, end), max(x, end)) > y + _LINE:
                break  # a line beside the peak would cross the curve
            line = min(x, end) - _LINE, y, max(x, end) + _LINE, bottom
            options.append((bottom + worse, (text, line)))
    return [boxes for _, boxes in sorted(options)]


def end_of_line(peak: Sequence[float], text: Box) -> tuple[float, float]:
    """End of a line from a peak to its label."""
    return min(max(peak[0], text[0]), text[2]), text[1]
