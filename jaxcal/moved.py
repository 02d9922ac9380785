"""Import paths of 0.2 whose modules have moved; they work, and warn, until 0.4."""

import importlib
import sys
from importlib.machinery import ModuleSpec

MOVED = {  # longer names first
    "jaxcal.adaptive.journal": "jaxcal.adaptive.loop",
    "jaxcal.adaptive.policy.features": "jaxcal.adaptive.policy.network",
    "jaxcal.adaptive.policy.sessions": "jaxcal.adaptive.policy.network",
    "jaxcal.plots.curves": "jaxcal.reports.plots",
    "jaxcal.plots.scatter": "jaxcal.reports.plots",
    "jaxcal.plots.style": "jaxcal.reports.plots",
    "jaxcal.calibration.budget": "jaxcal.reports.budget",
    "jaxcal.calibration.report": "jaxcal.reports.calibration",
    "jaxcal.commands.train_arguments": "jaxcal.commands.train_configuration",
    "jaxcal.csvtable": "jaxcal.tables",
    "jaxcal.evaluation.dataset_files": "jaxcal.evaluation.dataset",
    "jaxcal.evaluation.parameters": "jaxcal.evaluation.methods",
    "jaxcal.evaluation.training_figure": "jaxcal.evaluation.figures",
    "jaxcal.evaluation.results": "jaxcal.evaluation.report",
    "jaxcal.evaluation.sequential": "jaxcal.adaptive.evaluation",
    "jaxcal.learning.environments.brax_env": "jaxcal.learning.brax",
    "jaxcal.learning.environments.randomness": "jaxcal.learning.environments.selection",
    "jaxcal.learning.policies.geometry": "jaxcal.learning.policies.features",
    "jaxcal.learning.policies.networks": "jaxcal.learning.core.network",
    "jaxcal.learning.runtime.cache": "jaxcal.learning.runtime.processes",
    "jaxcal.learning.environments.scenarios": "jaxcal.learning.environments.selection",
    "jaxcal.learning.settings": "jaxcal.learning.config",
    "jaxcal.learning.training.config": "jaxcal.learning.training.presets",
    "jaxcal.learning.training.imitation": "jaxcal.learning.training.postures",
    "jaxcal.models.affine": "jaxcal.models.linear",
    "jaxcal.models.sensors.distance": "jaxcal.arms.sensors.landmarks",
    "jaxcal.models.sensors.gravity": "jaxcal.arms.sensors.at_rest",
    "jaxcal.models.sensors.plane": "jaxcal.arms.sensors.landmarks",
    "jaxcal.models.sensors.pose": "jaxcal.arms.sensors.sensor",
    "jaxcal.models.sensors.position": "jaxcal.arms.sensors.sensor",
    "jaxcal.models.sensors.socket": "jaxcal.arms.sensors.landmarks",
    "jaxcal.models.sensors": "jaxcal.arms.sensors",
    "jaxcal.models.verdict": "jaxcal.calibration.verdict",
    "jaxcal.models.serial.kernel": "jaxcal.arms.chain_kernel",
    "jaxcal.models.serial.urdf": "jaxcal.arms.files.urdf",
    "jaxcal.models.serial": "jaxcal.arms",
    "jaxcal.paper.constants": "jaxcal.paper.datasets",
    "jaxcal.paper.twin": "benchmarks.paper.twin",
    "jaxcal.pages": "jaxcal.reports.page",
    "jaxcal.plots": "jaxcal.reports.plots",
    "jaxcal.selection.continuous": "jaxcal.designs.continuous",
    "jaxcal.selection.exact.volume": "jaxcal.selection.exact.exact",
    "jaxcal.selection.fastest.motion": "jaxcal.designs.travel",
    "jaxcal.selection.fastest": "jaxcal.designs.travel",
    "jaxcal.selection.policy.compact": "jaxcal.selection.policy.by_checkpoint",
    "rig.model": "rig_workbench.model",
    "rig.readings.numbers": "rig_workbench.numbers",
    "rig.signals": "rig.faults",
    "rig.simulator.plant": "rig_workbench.simulator.simulator",
    "rig.simulator": "rig_workbench.simulator",
    "rig.workbench.commission.characterise": "rig_workbench.commission.characterise",
    "rig.workbench.commission.setup": "rig_workbench.commission.setup",
    "rig.workbench.commission.operator": "rig.prove.steps",
    "rig.workbench.commission": "rig.prove",
    "rig.workbench.identification.refit": "rig_workbench.refit",
    "rig.workbench.live.scene": "rig_workbench.live.page",
    "rig.workbench.live": "rig_workbench.live",
    "rig.workbench.outputs.export": "rig_workbench.outputs.export",
    "rig.workbench.outputs.report": "rig_workbench.outputs.report",
    "rig.workbench.outputs.trend": "rig_workbench.outputs.trend",
    "rig.workbench.outputs.view": "rig_workbench.outputs.view",
    "rig.workbench": "rig",
}


class Finder:
    """On ``sys.meta_path``, first: a folder that an older checkout left would be found
    as an empty package."""

    @staticmethod
    def find_spec(name: str, path: object = None, target: object = None) -> object:
        for old in MOVED if name.startswith(("jaxcal.", "rig.")) else ():
            if name == old or name.startswith(f"{old}."):
                new = MOVED[old] + name[len(old) :]
                return ModuleSpec(name, Finder, origin=new)  # type: ignore[arg-type]
        return None

    @staticmethod
    def create_module(spec: ModuleSpec) -> None:
        """None, for an empty module, which ``exec_module`` replaces."""

    @staticmethod
    def exec_module(module: object) -> None:
        import warnings

        old, new = module.__spec__.name, module.__spec__.origin  # type: ignore[attr-defined]
        text = f"{old} is {new} since jaxcal 0.3; the old name goes with 0.4"
        warnings.warn(text, DeprecationWarning, stacklevel=2)
        sys.modules[old] = here = importlib.import_module(new)
        vars(here).setdefault("__path__", [])  # of a package that is one module now
