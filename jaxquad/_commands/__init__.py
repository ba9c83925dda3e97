"""The commands of `jaxquad`, one module each: `add` declares it, its `run` returns an exit code."""
