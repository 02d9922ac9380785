"""What is not proved limits pulses and speed: wrong gearings, radians, bare Enter."""

import re

import numpy as np
import pytest
from commission import device, quick_text
from harness import fast_config
from hypothesis import given
from hypothesis import strategies as st

from rig.__main__ import main
from rig.config import ConfigError, load_config, parse_config
from rig.config.config import EXAMPLES
from rig.core import proof
from rig.core.proof import GROWTH, Reach
from rig.faults import MotionFault, Refused
from rig.prove.axis_check import require_gearing, require_unit
from rig.prove.steps import Operator
from rig_workbench.commission import setup as wizard
from rig_workbench.simulator import Truth, parse_fault
from rig_workbench.simulator.drive import SimDrive


@pytest.fixture
def slow(at, monkeypatch):
    """Speeds as they are with a real device."""
    monkeypatch.undo()
    monkeypatch.chdir(at)
    monkeypatch.setattr(wizard, "WATCH_S", 0.3)
    return at


class Watch:
    """How far and how fast the joints of a simulated device went, by its plant."""

    def __init__(self, sim):
        self.far = np.zeros(3)
        self.fast = np.zeros(3)
        self._start = sim.plant.joints()
        self._sim, self._attitude = sim, sim.plant.attitude
        sim.plant.attitude = self._look

    def _look(self):
        sim = self._sim
        joints = sim.plant.joints()
        self.far = np.maximum(self.far, np.abs(joints - self._start))
        for index, (axis, drive) in enumerate(
            zip(sim.config.axes, sim.drives, strict=True)
        ):
            true = 360.0 / (drive.pulses_per_rev * axis.reduction)
            speed = abs(drive.velocity) * true * sim.truth.matrix[index][index]
            self.fast[index] = max(self.fast[index], speed)
        return self._attitude()


def axes_of(text: str, values: dict[str, object]) -> str:
    for key, value in values.items():
        text = re.sub(rf"(?m)^{key} = .*$", f"{key} = {value}", text)
    return text


@pytest.mark.slow
@pytest.mark.parametrize("factor", [10, pytest.param(100, marks=pytest.mark.slow)])
def test_a_reduction_that_is_too_high_moves_nothing_far_or_fast(slow, factor, capsys):
    """B: the joint went to 7 (50) degrees at 50 (500) degrees a second."""
    with device(speedup=1.0) as (sim, bus, port):
        text = quick_text(bus, port)
        text = axes_of(text, {"reduction": 10.0 * factor, "speed_deg_s": 10})
        (slow / "rig.toml").write_text(text)
        assert main(["scan", "--units", "3"]) == 0
        assert main(["home", "--here", "--yes"]) == 0
        watch = Watch(sim)
        assert main(["axes", "--yes"]) == 0, capsys.readouterr().out
    found = [axis.reduction for axis in load_config("rig.toml").axes]
    np.testing.assert_allclose(found, 10.0 / np.diag(Truth().matrix), rtol=0.05)
    assert watch.far.max() < 5.0
    assert watch.fast.max() < 8.0


def test_a_jog_before_the_check_stops_where_the_phone_has_turned(slow, capsys):
    with device(speedup=1.0) as (sim, bus, port):
        text = axes_of(quick_text(bus, port), {"reduction": 1000, "speed_deg_s": 10})
        (slow / "rig.toml").write_text(text)
        assert main(["scan", "--units", "3"]) == 0
        watch = Watch(sim)
        assert main(["jog", "roll", "2", "--yes"]) == 0
    assert "Check the reduction of roll" in capsys.readouterr().out
    assert 0.5 < watch.far.max() < 5.0
    assert watch.fast.max() < 8.0


@pytest.mark.slow
def test_three_ratios_near_a_radian_name_the_unit(slow, capsys):
    """A: `reduction = 573 (is 10)` was proposed, and joints went to 172 degrees."""
    with device(speedup=1.0, faults=[parse_fault("imu_radians")]) as (sim, bus, port):
        text = axes_of(quick_text(bus, port), {"speed_deg_s": 10})
        (slow / "rig.toml").write_text(text)
        assert main(["scan", "--units", "3"]) == 0
        assert main(["home", "--here", "--yes"]) == 0
        watch = Watch(sim)
        before = (slow / "rig.toml").read_text()
        assert main(["axes", "--yes"]) == 3
    said = capsys.readouterr().out
    assert 'Set imu.unit = "rad"' in said and "reduction =" not in said
    assert (slow / "rig.toml").read_text() == before
    assert watch.far.max() < 5.0


@pytest.mark.slow
def test_radians_with_a_reduction_that_is_too_high_move_nothing_far(slow, capsys):
    """The two together look right: 57 times too far, of which a 57th is seen."""
    with device(speedup=1.0, faults=[parse_fault("imu_radians")]) as (sim, bus, port):
        text = quick_text(bus, port)
        text = axes_of(text, {"reduction": 250.0, "speed_deg_s": 10})
        (slow / "rig.toml").write_text(text)
        assert main(["scan", "--units", "3"]) == 0
        assert main(["home", "--here", "--yes"]) == 0
        watch = Watch(sim)
        assert main(["axes", "--yes"]) == 3
    assert watch.far.max() < 6.0
    assert "imu.unit" in capsys.readouterr().out


@pytest.mark.parametrize("ratios", [(0.43, 0.71, 0.87), (1.0, 1.0, 0.1)])
def test_two_sound_gearings_prove_the_unit(ratios):
    assert require_unit(fast_config(), ratios) is None
    with pytest.raises(MotionFault):  # one of them does not
        require_unit(fast_config(), [ratios[0], *(0.1 for _ in ratios[1:])])


@pytest.mark.parametrize("ratios", [(0.1, 0.1, 0.1), (10.0, 10.0, 1.0)])
def test_no_gearing_is_blamed_where_the_unit_is_not_proved(ratios):
    with pytest.raises(MotionFault, match=r"either imu\.unit or the gearings"):
        require_unit(fast_config(), ratios)


@pytest.mark.parametrize("ratios", [(0.1, 0.1, 0.1), (10.0, 0.3, 4.0)])
def test_a_gearing_far_off_on_all_axes_wants_the_drives_own_word(ratios):
    """A: ten times on all three was corrected by the phone alone."""
    config = fast_config()
    with pytest.raises(MotionFault, match="the drive of roll has no register"):
        require_gearing(config, ratios, (10000, 10000, None))
    assert require_gearing(config, ratios, (10000,) * 3) is None
    assert require_gearing(config, (ratios[0], 0.7, ratios[2]), (None,) * 3) is None
    assert require_gearing(config, (1.9, 1.8, 1.6), (None,) * 3) is None


@pytest.mark.slow
def test_ten_times_on_all_axes_of_drives_without_a_register_corrects_no_file(
    slow, capsys
):
    generic = fast_config({'map = "leadshine_pr"': 'map = "generic"'})
    with device(speedup=1.0, config=generic) as (sim, bus, port):
        text = quick_text(bus, port).replace("leadshine_pr", "generic")
        text = axes_of(text, {"reduction": 100.0, "speed_deg_s": 10})
        (slow / "rig.toml").write_text(text)
        assert main(["scan", "--units", "3"]) == 0
        assert main(["home", "--here", "--yes"]) == 0
        watch = Watch(sim)
        before = (slow / "rig.toml").read_text()
        assert main(["axes", "--yes"]) == 3
    assert "has no register for" in capsys.readouterr().out
    assert (slow / "rig.toml").read_text() == before
    assert watch.far.max() < 5.0


def test_a_frozen_phone_lets_no_axis_go_far(slow, capsys):
    """A file 100 times too high, and nothing seen: a degree commanded is 100."""
    with device(speedup=1.0, faults=[parse_fault("imu_frozen")]) as (sim, bus, port):
        text = axes_of(quick_text(bus, port), {"reduction": 1000, "speed_deg_s": 10})
        (slow / "rig.toml").write_text(text)
        assert main(["scan", "--units", "3"]) == 0
        watch = Watch(sim)
        assert main(["jog", "roll", "2", "--yes"]) == 3
    assert "may not turn further without a measured motion" in capsys.readouterr().out
    assert watch.far.max() < 5.0


@pytest.mark.parametrize(
    ("away_deg", "fault", "values", "said"),
    [(8, None, {}, None), (100, None, {}, r"the phone turned 5\d\.\d deg in a move"),
     (40, "imu_frozen", {}, "the phone measured no motion"),
     (15, None, {"speed_deg_s": 10, "max_speed_deg_s": 12}, "homes at .* by the phone"),
     (40, "imu_gap,seconds=20", {}, "silent|stale|no reading")],
    ids=["home", "too far", "frozen", "too fast", "silent"],
)  # fmt: skip
def test_a_drives_own_homing_is_watched_by_the_phone(
    at, away_deg, fault, values, said, capsys, monkeypatch
):
    with device(speedup=0.3 if fault else 1.0) as (sim, bus, port):
        drive = sim.drives[1]
        drive.position = float(sim.config.axes[1].to_pulses(away_deg))
        drive.target = round(drive.position)

        def home(drive, begin=SimDrive._home):
            if fault:
                sim.faults.add(parse_fault(fault))
            begin(drive)

        monkeypatch.setattr(SimDrive, "_home", home)
        text = axes_of(quick_text(bus, port), values)
        (at / "rig.toml").write_text(text)
        assert main(["scan", "--units", "3"]) == 0
        assert main(["home", "--yes"]) == (3 if said else 0)
        assert not any(drive.moving for drive in sim.drives)
    out = capsys.readouterr().out
    assert said is None or re.search(said, out), out


def test_degrees_that_are_read_as_radians_are_named_too():
    config = fast_config({"column_count = 4": 'column_count = 4\nunit = "rad"'})
    with pytest.raises(MotionFault, match=r'Set imu\.unit = "deg"'):
        require_unit(config, (57.0, 40.0, 62.0), proved=True)


@given(
    gain=st.floats(1e-6, 10.0), play=st.floats(0.0, 0.5), wanted=st.integers(1, 10**7)
)
def test_no_move_turns_a_joint_far_whatever_its_gearing(gain, play, wanted):
    """``gain``: degrees of the joint for a pulse; at first play hides a move."""
    axis = fast_config().axes[0]
    first = max(1, int(proof.FIRST_MOTOR_DEG / 360.0 * axis.pulses_per_rev))
    reach, most, count = Reach(axis), 3.0, 0
    for _ in range(40):
        longer = reach.pulses(wanted, most)
        if longer <= 1.1 * count:
            break
        assert longer <= GROWTH * max(count, first)
        count = longer
        turned = max(0.0, gain * count - play)
        assert gain * count <= max(gain * first, GROWTH * play + most + 0.1)
        reach.saw(count, turned, 0.01)
    else:
        pytest.fail("it never got there")
    assert count >= 0.9 * wanted or gain * count > 0.4 * most or count == 1


def test_enter_confirms_nothing():
    """I: Enter was a yes."""
    for answer in ("", "yes", "y"):
        operator = Operator(read=lambda _, a=answer: a, say=lambda _: None)
        with pytest.raises(Refused, match="not confirmed"):
            operator.confirm("axes: they move", "axes")
    Operator(read=lambda _: " axes ", say=lambda _: None).confirm("they move", "axes")


def test_no_file_asks_for_more_than_the_ceiling_of_speed():
    text = (EXAMPLES / "generic.toml").read_text()
    fast = re.sub(r"(?m)^speed_deg_s = 10", "speed_deg_s = 121", text)
    with pytest.raises(ConfigError, match=r"pitch\.speed_deg_s: .*max_speed_deg_s"):
        parse_config(fast)
    parse_config(fast.replace("[motion]", "[motion]\nmax_speed_deg_s = 121"))
