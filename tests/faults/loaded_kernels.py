"""Numba's own types and functions, loaded on import; else each process that calls a kernel does."""

from numba.core.registry import cpu_target

cpu_target.typing_context.refresh()
cpu_target.target_context.refresh()
