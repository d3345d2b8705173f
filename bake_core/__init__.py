"""octobake's core: scenes, tracing, probes, atlases and their error. Knows nothing of HTTP."""
