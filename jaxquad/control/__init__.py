from ._pd import PD as PD, place_pd as place_pd
