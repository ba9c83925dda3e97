from ._flights import (
    antx_pitch as antx_pitch,
    betaflight_ar8 as betaflight_ar8,
    cessna_xplane as cessna_xplane,
    crazyflie_rollpitch as crazyflie_rollpitch,
    crazypad_hover as crazypad_hover,
    DataFile as DataFile,
    FILES as FILES,
    locate as locate,
)
