"""Syntax trees of sources, parsed once for all tests that read them."""

import ast
from functools import cache


@cache
def tree_of(text):
    """Syntax tree of a source, which nobody changes."""
    return ast.parse(text)


@cache
def nodes_of(text):
    """All its nodes."""
    return tuple(ast.walk(tree_of(text)))
