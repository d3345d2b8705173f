"""octobake's core: scenes, tracing, probes, atlases and their error. Knows nothing of HTTP."""

__version__ = "0.1.0"
