"""What a count of rare events among independent draws proves."""


def upper_bound(count: int, draws: int, *, level: float = 0.95) -> float:
    """The share that is exceeded by no more than this, at the confidence `level`.

    Of `draws` independent members `count` showed the event; the bound is one-sided and exact, not
    an approximation by a normal distribution: none of 256 bounds the share by 1.2 %, none of 3000
    by 0.1 %. Source: Clopper & Pearson, Biometrika 26 (1934). Raises ValueError for a count beyond
    the draws and for a level outside 0 .. 1.
    """
    if not (0 <= count <= draws and draws >= 1):
        raise ValueError(f"{count} of {draws} members: give 1 draw or more, and a count among them")
    if not 0 < level < 1:
        raise ValueError(f"level is {level}: give a confidence between 0 and 1, such as 0.95")
    if count == draws:
        return 1.0
    from scipy.special import betaincinv

    return float(betaincinv(count + 1, draws - count, level))
