"""The version of jaxquad, by the metadata of what is installed."""

from importlib.metadata import PackageNotFoundError, version


try:
    __version__ = version("jaxquad")
except PackageNotFoundError:
    __version__ = "0+not.installed"  # a source tree on the path
