"""Progress bars: a notebook without widgets has a bar, and no warning."""

import subprocess
import sys

_NOTEBOOK = """
import sys, types, warnings
warnings.simplefilter("error")
sys.modules["ipywidgets"] = None                       # not installed
shell = types.SimpleNamespace(config={"IPKernelApp": {}})
core = types.ModuleType("IPython"); core.get_ipython = lambda: shell
sys.modules["IPython"] = core
from apt_evap._common.progress import progress_bar
progress_bar(total=1, disable=True).update()
"""


def test_a_notebook_without_widgets_gets_no_warning():
    done = subprocess.run([sys.executable, "-c", _NOTEBOOK], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
