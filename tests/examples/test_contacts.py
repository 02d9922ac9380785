"""Contacts of a real arm: a few that are chosen are better than as many at random."""

import common
import contacts
import numpy as np
import pytest


@pytest.mark.slow
def test_twelve_chosen_contacts_calibrate_an_arm(tmp_path):
    found = common.main(contacts, ["--out", str(tmp_path)])
    error = {rule: np.mean(values) for (_, rule, _), values in found.items()}
    assert error["nominal"] > 7.0  # mm
    assert error["all"] < error["I"] < error["random"]
    assert error["I"] < 0.12 * error["nominal"]
    assert (tmp_path / "contacts.csv").exists()
    assert (tmp_path / "contacts.png").stat().st_size > 5_000


def test_the_measure_is_the_mean_distance_from_the_mean():
    arm = contacts.arm("kuka_14")
    joints, sockets = contacts.load("kuka_14")["front"]
    nominal = arm.calibrated(arm.nominal)
    points = nominal.predict(joints) * 1000.0
    off = []
    for k in (0, 1):
        mine = [point for point, s in zip(points, sockets, strict=True) if s == k]
        middle = sum(mine) / len(mine)
        off += [float(np.sqrt(((point - middle) ** 2).sum())) for point in mine]
    assert contacts.consistency(nominal, (joints, sockets)) - np.mean(off) < 1e-12
    assert 0.6 < np.mean(off) < 0.9
