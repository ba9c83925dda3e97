"""Whether the methods of a user's class take the arguments that they are called with."""

import inspect


def require_signature(part: object, protocol: type, method: str, count: int, *names: str) -> None:
    """Raises ValueError where the method is there and does not take such a call.

    **Arguments:**

    - `protocol`: a public class that has the expected signature.
    - `count`: how many arguments are passed by position, whatever they are called.
    - `names`: those that are passed by name.
    """
    try:
        signature = inspect.signature(getattr(part, method))
    except (AttributeError, TypeError, ValueError):  # none, or one that Python cannot read
        return
    try:
        signature.bind(*range(count), **dict.fromkeys(names))
    except TypeError as error:
        expected = list(inspect.signature(getattr(protocol, method)).parameters.values())[1:]
        room = protocol.__module__.split(".")[1]
        raise ValueError(
            f"{type(part).__name__} has {method}{_show(list(signature.parameters.values()))}, "
            f"which cannot be called as needed ({error}): define {method}{_show(expected)}, as "
            f"jq.{room}.{protocol.__name__}. Arguments are passed by position, those after * by "
            "name"
        ) from error


def _show(parameters: list[inspect.Parameter]) -> str:
    """With `self`, and without types."""
    bare = inspect.Signature([x.replace(annotation=x.empty) for x in parameters])
    return f"(self{', ' if parameters else ''}{str(bare)[1:]}"
