"""Read the logs of a checker, print the findings in the compiled core, and fail if there are any.

Python, NumPy and SciPy do not free all memory at exit. A leak is attributed to the core if a function of the core is
among the callers, except for the loading of its modules.
"""

import re
import sys
from pathlib import Path

CORE = re.compile(r"apt_evap/_core/\w+\.")
LOADING = re.compile(r"__pyx_pymod_exec|PyInit_|__Pyx_InitConstants|__Pyx_CreateStringTabAndInitStrings")
LEAK = re.compile(r"leak of|(?:definitely|indirectly) lost|are possibly lost|still reachable in loss")
ERROR = re.compile(
    r"ERROR: AddressSanitizer|runtime error:|WARNING: ThreadSanitizer|uninitialised|Invalid (?:read|write|free)"
    r"|Mismatched free|overlap in"
)
FRAME = re.compile(r"^\s*(?:#\d+|at|by)\b")


def paragraphs(text):
    """Paragraphs of a log, without the process numbers at the start of valgrind's lines."""
    text = re.sub(r"^(?:==|--)\d+(?:==|--) ?", "", text, flags=re.MULTILINE)
    return [part for part in re.split(r"\n\s*\n", text) if part.strip()]


def concerns_the_core(paragraph):
    """Whether a paragraph is a finding in the core."""
    frames = "\n".join(line for line in paragraph.splitlines() if FRAME.match(line))
    if LEAK.search(paragraph):
        return bool(CORE.search(frames)) and not LOADING.search(frames)
    return bool(ERROR.search(paragraph)) and bool(CORE.search(paragraph))


def main():
    """Print the findings in the core."""
    n_findings = n_core = 0
    for path in map(Path, sys.argv[1:]):
        if path.is_file():
            for paragraph in paragraphs(path.read_text(errors="replace")):
                n_findings += bool(LEAK.search(paragraph) or ERROR.search(paragraph))
                if concerns_the_core(paragraph):
                    n_core += 1
                    print(paragraph, end="\n\n")
    print(f"{n_findings} findings in the logs, {n_core} in the core")
    return 1 if n_core else 0


if __name__ == "__main__":
    sys.exit(main())
