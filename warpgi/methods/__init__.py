"""The methods, by the name that the command line and the bench know them by."""

from warpgi.methods.path import PathTracing, Sampler

#: Name of a method, the stem of its files, -> its settings.
METHODS = {"path": PathTracing}

__all__ = ["METHODS", "PathTracing", "Sampler"]
