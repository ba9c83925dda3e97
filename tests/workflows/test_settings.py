"""Settings are the same in Python, on the command line, in TOML and in results."""

import json

import pytest

from jaxquad.cli import make_parser
from jaxquad.workflows import (
    BatchSettings,
    IdentifySettings,
    Override,
    SettingsError,
    TuneSettings,
)


EVERY = [
    IdentifySettings(),
    IdentifySettings(
        input="roll=-m1-m2+0.5*m3^2", output="p", reference="x 0", units={"p": "rad/s", "m1": "V"},
        time="stamp", time_unit="ms", rate=250, segments=[(-3, 5.5), (22, 30)], band=(0.7, 12),
        integrators=0, delay=False, poles=3, zeros=1, estimator="welch", window=0.1,
        valid={"m1": (-20, 20.5), "p q": (0, 1e6)}, max_gap=0.05,
        cost="coherence", verify="b.npz", verify_start=-1e-3, verify_stop=1e6,
    ),
    IdentifySettings(axis="pitch", start=-2.5, stop=1 / 3, band_rad=(1, 2), lag=False),
    IdentifySettings(input="u[0]", output="p", other_inputs=["u[1]", "b=-m1+0.5*m2"]),
]  # fmt: skip


def typed(words):
    """The settings that the command line understands."""
    options = vars(make_parser().parse_args(["identify", "log", *words]))
    keys = IdentifySettings.options()
    return IdentifySettings(**{key: value for key, value in options.items() if key in keys})


@pytest.mark.parametrize("settings", EVERY, ids=range(len(EVERY)))
def test_settings_survive_the_command_line_and_json(settings):
    assert typed(settings.words()) == settings
    text = json.dumps(settings.content(), allow_nan=False)
    assert IdentifySettings.from_mapping(json.loads(text)) == settings


def test_toml_says_the_same_as_python(tmp_path):
    path = tmp_path / "identify.toml"
    path.write_text('input = "M"\noutput = "q"\nband = [1, 2]\nlag = false\n[units]\nq = "rad/s"\n')
    same = IdentifySettings(input="M", output="q", band=(1, 2), lag=False, units={"q": "rad/s"})
    assert IdentifySettings.from_toml(path) == same
    path.write_text("inertia = 0.05\nlimit = 10\n")
    assert TuneSettings.from_toml(path) == TuneSettings(inertia=0.05, limit=10)


def test_a_mix_of_channels_may_be_a_mapping():
    content = {"input": {"roll": {"m1": -1.0, "m2": 0.5}}, "output": "p"}
    assert IdentifySettings.from_mapping(content).input == "roll=-1.0*m1+0.5*m2"


def test_an_option_takes_the_place_of_what_says_the_same_in_a_file():
    settings = IdentifySettings(band_rad=(1, 2), start=3).changed({"band": [4, 5]})
    assert (settings.band, settings.band_rad, settings.start) == ((4, 5), None, 3)
    assert settings.changed({"segments": ["1:2"]}).start is None


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ({"estimater": "welch"}, "unknown key 'estimater'; did you mean 'estimator'"),
        ({"xyz": 1}, "unknown key 'xyz'; known keys: input, output"),
        ({"rate": "fast"}, "rate is 'fast': give a number above 0"),
        ({"rate": 0}, "rate is 0: give a number above 0"),
        ({"poles": True}, "poles is True: give a whole number of at least 0"),
        ({"lag": "no"}, "lag is 'no': give true or false"),
        ({"estimator": "best"}, "estimator is 'best': choose one of local, composite, welch"),
        ({"band": [3, 1]}, r"band is \[3, 1\]: give two numbers above 0, the lower one first"),
        ({"band": [0, 1]}, "give two numbers above 0"),
        ({"band": 5}, "give two numbers above 0"),
        ({"start": float("nan")}, "start is nan: give a number"),
        ({"segments": [[3, 1]]}, r"\[3, 1\] is no START:STOP in s: write 22:30.5"),
        ({"segments": [5, 9]}, "5 is no START:STOP"),
        ({"segments": 5}, r"give a list of \[start, stop\]"),
        ({"segments": [[1, 2]], "start": 0}, "segments says where to start and stop"),
        ({"band": [1, 2], "band_rad": [1, 2]}, "both given: keep one"),
        ({"input": "roll=a b", "output": "q"}, "input is 'roll=a b': .*cannot read"),
        ({"input": 5, "output": "q"}, "input is 5: give a channel"),
        ({"input": "M"}, "input and output belong together"),
        ({"input": "M", "output": "q", "axis": "roll"}, "axis is for a proposal"),
        ({"units": "rad"}, "units is 'rad': give the unit of each channel"),
        ({"units": ["q"]}, "'q' is no NAME=UNIT"),
        ({"valid": ["q=3:1"]}, "'q=3:1' is no NAME=LOW:HIGH: write q=-20:20"),
        ({"valid": {"q": 3}}, "is no NAME=LOW:HIGH"),
        ({"valid": 3}, "valid is 3: give the valid range of each channel"),
        ({"max_gap": 0}, "max_gap is 0: give a number above 0"),
        ({"zeros": 1}, "zeros is for a transfer function: say its poles"),
        ({"poles": 2, "lag": False}, "lag is for a model of gain, lag and delay"),
        ({"window": 5, "estimator": "composite"}, "window is for windows of one length"),
        ({"verify_start": 3}, "verify_start and verify_stop are for a second record"),
        ({"input": "M", "output": "q", "other_inputs": ["M"]}, "give each signal once"),
        ({"reference": "r", "other_inputs": ["L"], "estimator": "welch"}, "need local polynomials"),
    ],
)
def test_settings_that_cannot_be_say_what_to_change(content, complaint):
    with pytest.raises(SettingsError, match=f"^file.toml: .*{complaint}"):
        IdentifySettings.from_mapping(content, "file.toml")


@pytest.mark.parametrize("text", ["5", "5:", "9:3", "a:b", "3:3", "nan:5", "0:inf", "1:2:3"])
def test_a_segment_is_a_start_and_a_later_stop(text):
    with pytest.raises(SettingsError, match="is no START:STOP"):
        IdentifySettings.from_mapping({"segments": [text]})


def test_required_settings_are_named():
    with pytest.raises(SettingsError, match=r"`inertia` \(.*kg m\^2.*\) and `limit` \(.*\)"):
        TuneSettings.from_mapping({})
    with pytest.raises(SettingsError, match="`spread` is .*the lower one first"):
        TuneSettings(inertia=1, limit=1, spread=(3, 0.5))
    with pytest.raises(SettingsError, match="`step` is 0: give a number above 0"):
        TuneSettings(inertia=1, limit=1, step=0)


def test_a_batch_is_read_with_overrides_by_pattern(tmp_path):
    path = tmp_path / "fleet.toml"
    path.write_text("""
logs = ["*.npz", "old/*.csv"]
timeout = 60
input = "M=right-left"
output = "q"
band = [0.5, 6]
lag = false
[units]
q = "rad/s"
[[override]]
logs = "old/*"
output = "gyro"
[[override]]
logs = "old/7*"
rate = 50
""")
    settings = BatchSettings.from_toml(path)
    assert settings.logs == ("*.npz", "old/*.csv") and settings.timeout == 60
    assert settings.of("new.npz").output == "q" and settings.of("old/6.csv").rate is None
    assert settings.of("old/7.csv").changes() == settings.of("old/6.csv").changes() | {"rate": 50}
    assert settings.of("old/7.csv").output == "gyro"
    same = BatchSettings(
        logs=["*.npz", "old/*.csv"],
        timeout=60,
        identify={
            "input": "M=right-left", "output": "q", "band": (0.5, 6), "lag": False,
            "units": {"q": "rad/s"},
        },
        overrides=[Override(("old/*",), {"output": "gyro"}), Override(("old/7*",), {"rate": 50.0})],
    )  # fmt: skip
    assert settings == same


def test_an_override_replaces_what_says_the_same_in_another_way():
    settings = BatchSettings(
        identify=IdentifySettings(start=5, stop=9, band=(1, 2)),
        overrides=[
            Override(("a*",), {"segments": [[1, 2], [3, 4]], "band_rad": [2, 9]}),
            Override(("ab",), {"stop": 7}),
        ],
    )
    assert settings.of("a").changes() == {"segments": ((1, 2), (3, 4)), "band_rad": (2, 9)}
    assert settings.of("ab").changes() == {"stop": 7, "band_rad": (2, 9)}
    assert settings.of("b").changes() == {"start": 5, "stop": 9, "band": (1, 2)}


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ({"estimater": "welch"}, "unknown key 'estimater'; did you mean 'estimator'"),
        ({"verify": "b.npz"}, "unknown key 'verify'"),
        ({"override": [{"logs": "a", "ouput": "q"}]}, "override 1: .*did you mean 'output'"),
        ({"override": [{"output": "q"}]}, "override 1: logs is missing"),
        ({"override": 5}, r"write \[\[override\]\]"),
        ({"override": [{"logs": "a", "rate": -1}]}, "override 1: rate is -1"),
        ({"rate": "fast"}, "rate is 'fast': give a number above 0"),
        ({"band": [1, 2], "band_rad": [1, 2]}, "both given: keep one"),
        ({"segments": [[1, 2]], "stop": 5}, "both given: keep one"),
        ({"logs": "/etc/*"}, "patterns relative to the folder"),
        ({"logs": []}, "give a file pattern"),
        ({"timeout": "long"}, "timeout is 'long': give a number above 0"),
        ({"timeout": 0}, "timeout is 0: give a number above 0"),
        ({"workers": 0}, "workers is 0: give a whole number of at least 1"),
        ({"timeout": 5, "scheduler": "tcp://none:1"}, "leave it out with scheduler"),
    ],
)
def test_batch_settings_that_cannot_be_say_what_to_change(content, complaint):
    with pytest.raises(SettingsError, match=f"^fleet.toml: .*{complaint}"):
        BatchSettings.from_mapping(content, "fleet.toml")


@pytest.mark.parametrize("limit", [0, -1, float("inf"), float("nan")])
def test_a_timeout_is_finite_and_above_zero(limit):
    with pytest.raises(SettingsError, match="`timeout` is .*: give a number"):
        BatchSettings(timeout=limit)


def test_a_file_of_settings_that_is_not_there_is_named(tmp_path):
    with pytest.raises(SettingsError, match="absent.toml: there is no such file in "):
        IdentifySettings.from_toml(tmp_path / "absent.toml")
