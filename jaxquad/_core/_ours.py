"""Which errors and warnings are in words of the package, for its users."""


def is_ours(kind: type[BaseException]) -> bool:
    """Whether a class of errors or warnings is the package's; those of NumPy, for one, are not."""
    return kind.__module__.partition(".")[0] == "jaxquad"
