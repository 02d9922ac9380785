"""Categories of a formula, against those that formulaic makes of the words."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from formulaic import Formula

import jaxcal
from jaxcal.commands import main
from jaxcal.models import Linear

RNG = np.random.default_rng(0)
MATERIALS = ["steel", "alu", "brass"]
TABLE = pd.DataFrame(
    {
        "x": RNG.uniform(0.0, 9.0, 30).round(3),
        "material": RNG.choice(MATERIALS, 30),
        "gear": RNG.choice([1, 2, 5], 30),
    }
)
MATERIAL, GEAR = f"C(material, levels={MATERIALS})", "C(gear, levels=[1, 2, 5])"
MODEL = Linear(f"1 + x + {MATERIAL}", inputs=["material", "x"])
TRUTH = np.array([1.0, 0.5, 2.0, -3.0])


@pytest.mark.parametrize(
    "formula",
    [
        "1 + x + {m}",
        "0 + x + {m}",
        "1 + x*{m}",
        "1 + {m} + {g}",
        "0 + {m} + {g}",
        "1 + {m}*{g}",
        "1 + x + {g}:x",
        "1 + {g}*I(x**2)",
    ],
)
def test_features_span_what_formulaic_makes(formula):
    typed = formula.format(m=MATERIAL, g=GEAR)
    features = Linear(typed, inputs=["x", "material", "gear"]).jacobian(
        TABLE.assign(material=[float(MATERIALS.index(x)) for x in TABLE.material])
    )[:, 0]
    theirs = Formula(formula.format(m="C(material)", g="C(gear)"))
    others = theirs.get_model_matrix(TABLE, context={}).to_numpy(np.float64)
    rank = np.linalg.matrix_rank(features)
    assert rank == features.shape[1] == np.linalg.matrix_rank(others)
    assert rank == np.linalg.matrix_rank(np.hstack([features, others]))


@pytest.mark.filterwarnings("ignore:.*is ignored .not needed")
def test_words_of_a_frame_are_chosen_from_fitted_and_predicted():
    rows = [MATERIALS.index(x) for x in TABLE.material]
    measured = 1.0 + 0.5 * TABLE.x + np.array([0.0, 2.0, -3.0])[rows]
    fit = jaxcal.identify(
        TABLE, (measured + RNG.normal(0.0, 0.01, 30)).to_frame("y"), model=MODEL
    )
    assert MODEL.names == ("1", "x", "material[alu]", "material[brass]")
    assert np.abs(fit.estimate - TRUTH).max() < 0.02
    again = jaxcal.Calibration.from_dict(fit.to_dict())
    assert np.array_equal(again.predict(TABLE), fit.predict(TABLE))
    material, x = again.command_for([[3.0]])[0]
    assert material in (0.0, 1.0, 2.0)  # that of the nearest measurement
    assert fit.predict([[material, x]])[0] == pytest.approx(3.0)
    chosen = jaxcal.select(TABLE, 6, model=MODEL).indices
    assert {*TABLE.material[chosen]} == {*MATERIALS}
    masked = TABLE.assign(available=TABLE.index > 0)
    masked.loc[0, "material"] = None
    assert 0 not in jaxcal.select(masked, 6, model=MODEL).indices
    with pytest.raises(ValueError, match="row 0, column 'material' must hold a number"):
        jaxcal.select(masked.drop(columns="available"), 6, model=MODEL)


@pytest.mark.parametrize(
    ("formula", "rule"),
    [
        ("1 + C(x)", "an input and its levels"),
        ("1 + C(x + 1, levels=[1, 2])", "an input and its levels"),
        ("1 + C(x, levels=[1])", "two or more"),
        ("1 + C(x, levels=[1, 1])", "two or more"),
        ("1 + C(x, levels=['a', 1])", "numbers or words"),
        ("1 + C(x, levels=['1', '2'])", "begin with a letter"),
        ("1 + C(x, levels=[y, 2])", "an input and its levels"),
        ("x + C(x, levels=['a', 'b'])", "must be used as"),
        ("C(x, levels=[1, 2]):y + C(x, levels=[1, 3])", "two lists of levels"),
    ],
)
def test_a_category_states_its_levels(formula, rule):
    with pytest.raises(ValueError, match=rule):
        Linear(formula)


def test_another_level_is_named_with_its_row():
    with pytest.raises(ValueError, match="2 brass, got 3 in row 1"):
        MODEL.predict([[0.0, 1.0], [3.0, 1.0]], TRUTH)
    with pytest.raises(ValueError, match=r"row 0, column .material. .* got .wood."):
        MODEL.predict(
            TABLE.replace({"material": "wood"}).assign(material="wood"), TRUTH
        )


def test_words_of_a_file(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    TABLE.to_csv("t.csv", index=False)
    rows = [MATERIALS.index(x) for x in TABLE.material]
    y = 1.0 + 0.5 * TABLE.x + np.array([0.0, 2.0, -3.0])[rows]
    y += RNG.normal(0.0, 0.01, 30)
    TABLE.assign(y=y).to_csv("read.csv", index=False)
    (tmp_path / "model.py").write_text(
        "from jaxcal.models import Linear\n"
        f'model = Linear("1 + x + {MATERIAL}", inputs=["material", "x"])\n'
    )
    assert main("select t.csv -k 5 --model model.py".split()) == 0
    typed = "identify read.csv --model model.py --outputs y --out c.json"
    assert main(typed.split()) == 0
    assert main("predict c.json t.csv --out p.csv".split()) == 0
    assert np.abs(pd.read_csv("p.csv")["y"] - y).max() < 0.05
    TABLE.assign(material="wood").to_csv("t.csv", index=False)
    assert main("select t.csv -k 5 --model model.py".split()) == 2
    assert "one of steel, alu, brass, got 'wood'" in capsys.readouterr().err
