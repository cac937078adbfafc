"""The loader for PyTorch of the docs, with stand-ins for its classes: PyTorch is no dependency."""

import re
import sys
import textwrap
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

import apt_evap as ae

PAGE = Path(__file__).parents[2] / "docs" / "howto" / "data_set.rst"


@pytest.mark.parametrize("workers", [1, 3])
def test_workers_stream_every_example_once(monkeypatch, workers):
    torch, utils, data = (ModuleType(name) for name in ("torch", "torch.utils", "torch.utils.data"))
    torch.tensor, torch.float32 = lambda values, dtype: np.asarray(values, dtype), np.float32
    data.IterableDataset = object
    for module in (torch, utils, data):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    code = re.search(r"( +)def torch_stream.*?return Maps\(\)\n", PAGE.read_text(), re.DOTALL)[0]
    names = {}
    exec(textwrap.dedent(code), names)
    rng = np.random.default_rng(1)
    examples = [
        SimpleNamespace(
            hits=ae.Hits(x=rng.normal(size=50), y=rng.normal(size=50)), about={"orientation": np.eye(3) * k}
        )
        for k in range(7)
    ]
    streamed = []
    for number in range(workers):
        info = None if workers == 1 else SimpleNamespace(id=number, num_workers=workers)
        data.get_worker_info = lambda info=info: info
        streamed += list(names["torch_stream"](examples, bins=16))
    assert [orientation[0, 0] for _, orientation in streamed] == list(range(7))  # each once, in their order
    for (counts, _), example in zip(streamed, examples, strict=True):
        assert np.array_equal(counts, example.hits.map(bins=16).values)
