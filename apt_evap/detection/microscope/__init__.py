"""The lens of specimen, shank and electrode: boundary elements, and a run behind the lens."""
