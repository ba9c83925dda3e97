from collections.abc import Iterable


def starting(
    members: Iterable[str], *, measured: str | None, more: str = "", flags: Iterable[str] = ()
) -> tuple[str, ...]:
    """`init`, with all of the state 0 but for what `more` sets; `init_at` starts the `measured`."""
    lines = [f"state->{name}[k] = 0;" for name in members] + [more] * bool(more)
    body = "\n".join(f"        {line}" for line in lines)
    whole = "".join(f"    state->{flag} = 0;\n" for flag in flags)
    init = _INIT.replace("$lines", body).replace("$whole", whole)
    return (init,) if measured is None else (init, _INIT_AT.replace("$measured", measured))


_INIT = """\
/* At rest at angle 0. */
static inline void ${name}_init(${name}_state *state)
{
    for (int k = 0; k < ${NAME}_AXES; ++k) {
$lines
    }
$whole}"""

_INIT_AT = """\
/* At rest at a measurement. */
static inline void ${name}_init_at(${name}_state *state, const $real measurement[${NAME}_AXES])
{
    ${name}_init(state);
    for (int k = 0; k < ${NAME}_AXES; ++k)
        state->$measured[k] = measurement[k];
}"""
