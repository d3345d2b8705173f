"""Measurements that people repeat: error against run time, beside other renderers; what adapting and leaving out save."""
