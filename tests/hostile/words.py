"""Hostile command lines, environments and working directories."""

from __future__ import annotations

import pickle
from collections.abc import Iterator

from tests.hostile.case import EVALUATE, REPORT, RUN, TINY, Box, Case, every, put
from tests.hostile.files import calls
from tests.hostile.hook import PAYLOAD

UP = "../" * 20

#: Hydra's own settings. Alone they never run anything unless many runs are asked for, so they are fed both ways.
HYDRA = (
    "hydra.sweep.dir=OUTSIDE",
    f"+hydra.callbacks.x._target_={PAYLOAD}.Callback",
    f"++hydra.callbacks={{x:{{_target_:{PAYLOAD}.Callback}}}}",
    f"hydra.callbacks={{x:{{_target_:{PAYLOAD}.Callback}}}}",
    f"hydra.launcher._target_={PAYLOAD}.run",
    "++hydra.launcher._target_=hydra_plugins.hostile.run",
    "hydra/launcher=../../evil",
    "hydra/launcher=[basic,joblib]",
    "hydra/launcher@_global_=basic",
    "hydra.launcher.n_jobs=--5",
    "hydra/launcher=../x",
    "hydra/launcher=ray_aws",
    "hydra/launcher=submitit_slurm,../../evil",
    "hydra.launcher.setup=['touch CANARY']",
    "hydra.launcher.srun_args=['--prolog=CANARY']",
    "hydra.launcher.additional_parameters={prolog:CANARY}",
    "hydra.launcher.submitit_folder=OUTSIDE/%j",
    "hydra.launcher.partition='x\ntouch CANARY'",
    "hydra.launcher.partition=$(touch CANARY)",
    "hydra.launcher.account=x;touch${IFS}CANARY",
    "hydra.launcher.name=OUTSIDE/x",
    "hydra.launcher.timeout_min=${oc.env:HOSTILE_TAG}",
    "hydra.launcher.array_parallelism=1\n#SBATCH",
    "hydra.launcher.temp_folder=OUTSIDE",
    "hydra.launcher.ray.init.address=ray://OUTSIDE:10001",
    f"hydra.launcher.ray.init.runtime_env={{worker_process_setup_hook:{PAYLOAD}.run}}",
    "hydra.launcher.ray.init.num_cpus=0x10",
    "hydra.launcher.env_setup.commands=['touch CANARY']",
    f"hydra.sweeper={{_target_:{PAYLOAD}.run}}",
    f"hydra.job_logging={{version:1,handlers:{{h:{{'()':{PAYLOAD}.run}}}},root:{{handlers:[h]}}}}",
    "hydra.hydra_logging={version:1,handlers:{h:{class:logging.FileHandler,filename:CANARY}},root:{handlers:[h]}}",
    "hydra.searchpath=[file://OUTSIDE]",
    "hydra.sweep.subdir=../../../outside",
    "hydra.output_subdir=../../outside",
    "hydra.job.env_set.LD_PRELOAD=OUTSIDE/evil.so",
    "hydra.mode=MULTIRUN",
    " hydra.run.dir=OUTSIDE",
    "\n+hydra.sweep.dir=OUTSIDE",
    "'hydra.sweep.dir'=OUTSIDE",
    "HYDRA.sweep.dir=OUTSIDE",
    "hydra@x=default",
)
#: Values of settings that a launcher has, and that would go into a script or to a server.
LAUNCHED = (
    *("submitit_slurm hydra.launcher.partition=$(touch CANARY)", "submitit_slurm hydra.launcher.qos=x\ntouch CANARY"),
    *("submitit_slurm hydra.launcher.account='x;touch CANARY'", "submitit_slurm hydra.launcher.array_parallelism=1\n#SBATCH"),
    *("submitit_slurm hydra.launcher.setup=['touch CANARY']", "submitit_slurm hydra.launcher.srun_args=[--prolog=CANARY]"),
    *("submitit_slurm results_dir='x\ntouch CANARY'", "submitit_local hydra.launcher.timeout_min=${oc.env:HOSTILE_TAG}"),
    *("submitit_local hydra.launcher.submitit_folder=OUTSIDE", f"submitit_local hydra.launcher._target_={PAYLOAD}.run"),
    *("joblib hydra.launcher.temp_folder=OUTSIDE", "ray hydra.launcher.ray.init.address=ray://OUTSIDE:10001"),
)
#: Of `submit`, likewise.
SUBMITTED = (
    *("cluster.partition=$(touch CANARY)", "cluster.account='x\n#SBATCH --prolog=CANARY'", "cluster.qos='x;touch CANARY'"),
    *("cluster.name=os.system", "cluster.at_once=1\ntouch CANARY", "results_dir='x\ntouch CANARY'", "cluster.setup=CANARY"),
    *("hydra/launcher=joblib", "cluster={name:local,setup:[CANARY]}", "cluster.minutes=${oc.env:HOSTILE_TAG}"),
)
#: Settings: targets, paths, packages, interpolations, sweeps, sizes, texts that end on a terminal or in a path.
SETTINGS = (
    *("+x._target_=os.system", "~hydra", "agent.name=__import__", "buffer.hold.name=os.system", f"servo={PAYLOAD}.run"),
    *(f"servo={{_target_:{PAYLOAD}.run}}", "sim.urdf=OUTSIDE/evil.urdf", "experiment=OUTSIDE/evil", "experiment@hydra=A"),
    *(f"experiment='{UP}OUTSIDE/evil'", f"experiment=glob({UP}OUTSIDE/*)", f"experiment=choice(A,{UP}OUTSIDE/evil)"),
    *("experiment=${oc.env:HOSTILE_CHOICE}", "experiment=[A,../../evil]", f"reward@_global_={UP}OUTSIDE/evil"),
    *("reward@hydra.callbacks.x=plain", "name=../../x", "name=OUTSIDE/x", "name='a\\tb\\x1bc'", f"name={'x' * 5000}"),
    *("name=\udcff/../../../x", "seed=../../x", f"seed={'9' * 5000}", "results_dir=/proc/self/fd"),
    *("name=${oc.env:HOSTILE_TRAVERSAL}", "name=${oc.decode:${oc.env:HOSTILE_TAG}}", "name=${oc.create:{_target_:os.system}}"),
    *("name=${hydra:callbacks}", "name=${python:os.system}", "name=${name}", f"name={'${' * 300}x{'}' * 300}"),
    *("agent.hidden=[1000000000,1000000000]", f"agent.hidden={'[' * 3000}{']' * 3000}", "buffer.capacity=1000000000000"),
    *("\u202e=1", "seed=glob(*)", "seed=int(os.system)", "@OUTSIDE/arguments"),
)
BOTH_WAYS = ("+", "~", "experiment", "reward@", "name=$", "name=.", "name=O", "@")
OTHERS = {
    "evaluate": ("run=OUTSIDE/folder", "policy=OUTSIDE/config.pickle", "hold=os.system", "reward@common_reward=../../evil"),
    "report": ("results_dir=[1]", "+x._target_=os.system"),
    "render": ("run=[1,2]", "position=[nan,nan,nan]", "out=OUTSIDE/folder"),
}
OPTIONS = (
    *("--config-dir OUTSIDE", "--config-dir=OUTSIDE", "-cd OUTSIDE", "--config-path=OUTSIDE", "-cp OUTSIDE", "-cn evil"),
    *("--config-name=evil", "--experimental-rerun=OUTSIDE/config.pickle", "--experimental-rerun OUTSIDE/config.pickle"),
    *("--run", "-r", "--package=hydra", "-p hydra", "--info all", "-i", "--resolve -c job", "--hydra-help", "--version"),
    *("--multirun=1", "--cfg=hydra", "-mi", "-sc install=bash", "--shell-completion=install=bash"),
    f"-- hydra.callbacks.x._target_={PAYLOAD}.Callback",
)
COMPLETIONS = (
    "uarm-rl train --config-dir=OUTSIDE experiment=",
    f"uarm-rl train hydra.callbacks.x._target_={PAYLOAD}.Callback ",
    "uarm-rl train hydra.searchpath=[file://OUTSIDE] experiment=",
    "uarm-rl train experiment=../../",
    "uarm-rl train $(touch CANARY) `touch CANARY`",
    "uarm-rl \x1b[2J",
    "uarm-rl train " + "[" * 5000,
)
ENVIRONMENTS = {
    **{
        "HYDRA_FULL_ERROR": "1",
        "HYDRA_MAIN_MODULE": PAYLOAD,
        "HYDRA_CONFIG_DIR": "OUTSIDE",
        "MPLBACKEND": f"module://{PAYLOAD}",
    },
    **{"PYTHONIOENCODING": "ascii", "COMP_LINE": "uarm-rl train -sc", "TQDM_DISABLE": "CANARY", "OPENBLAS_NUM_THREADS": "-1"},
    **{"COLUMNS": "9" * 50, "TMPDIR": "OUTSIDE"},
}
SEEN = {
    "HOME": "OUTSIDE/home",
    "HOSTILE_TRAVERSAL": "../../outside/x",
    "HOSTILE_CHOICE": f"{UP}OUTSIDE/evil",
    "HOSTILE_TAG": "!!python/object/apply:os.system [true]",
}

EVIL = f"""\
# @package _global_
hydra:
  callbacks:
    x: {{_target_: {PAYLOAD}.Callback}}
  sweep: {{dir: OUTSIDE/sweep}}
name: evil
"""


def evil(box: Box) -> None:
    """What hostile command lines name: configurations, a pickled configuration, a file of arguments."""
    for path in (box.outside / "evil.yaml", box.outside / "train.yaml", box.cwd / "evil.yaml", box.root / "evil.yaml"):
        path.write_text(box.fill(EVIL))
    for name in ("config.pickle", "hydra.pickle"):
        (box.outside / name).write_bytes(pickle.dumps(calls(box)["a command"]))
    (box.outside / "arguments").write_text(f"hydra.callbacks.x._target_={PAYLOAD}.Callback\n")


def overrides() -> Iterator[Case]:
    for word in HYDRA:
        yield Case("Hydra's settings", word, ("train", *TINY, word), evil)
        yield Case("Hydra's settings, many runs", word, ("train", "-m", *TINY, word), evil)
    for line in LAUNCHED:
        launcher, _, word = line.partition(" ")
        yield Case("Hydra's settings", line, ("train", "-m", *TINY, f"hydra/launcher={launcher}", word), evil, SEEN)
    for line in SUBMITTED:
        yield Case("a cluster's settings", line, ("submit", *TINY, line), evil, SEEN)
    for word in SETTINGS:
        name, _, value = word.partition("=")
        harmless = name in ("name", "seed", "results_dir")
        named = (value,) if name == "results_dir" else ()
        for flags in ((), ("-m",)) if word.startswith(BOTH_WAYS) else ((),):
            what = " ".join((*flags, word[:80]))
            yield Case("override", what, ("train", *flags, *TINY, word), evil, SEEN, harmless, allowed=named)
    for command, words in OTHERS.items():
        for word in words:
            run = () if command == "report" or word.startswith("run") else (f"run={RUN}",)
            yield Case("override", f"{command} {word}", (command, *run, word), evil)


def surroundings() -> Iterator[Case]:
    for options in OPTIONS:
        yield Case("option", options, ("train", *TINY, *options.split()), evil)
        if "OUTSIDE" in options:
            words = ("-sc", "query=bash", *options.split())
            yield Case("option", f"-sc and {options}", words, evil, {"COMP_LINE": "uarm-rl train "}, accepted=True)
    for line in COMPLETIONS:
        completion = {"COMP_LINE": line, "COMP_POINT": str(len(line))}
        yield Case("completion", line[:60], ("-sc", "query=bash"), evil, completion, accepted=True)
    for name, value in ENVIRONMENTS.items():
        words = REPORT if name in ("MPLBACKEND", "COLUMNS", "TMPDIR") else ("train", "-m", *TINY)
        yield Case("environment", name, words, evil, {name: value}, accepted=True)


MODULES = "uarm_rl/__init__ uarm_rl/cli sitecustomize usercustomize hydra yaml numpy torch conf/__init__ "
MODULES += "hydra_plugins/hostile/__init__ hydra_plugins/hostile"
STYLE = (
    f"backend: module://{PAYLOAD}\ntext.usetex: True\ntext.latex.preamble: \\immediate\\write18{{touch CANARY}}\n"
    "axes.prop_cycle: cycler('color', [().__class__.__base__.__subclasses__()])\n"
    "animation.ffmpeg_path: CANARY\nsavefig.directory: OUTSIDE\n"
)


def starts() -> Iterator[Case]:
    """A working directory full of traps: modules, plugins, configurations that a start could pick up."""
    traps = every(
        *(put(f"{name}.py", f"import {PAYLOAD}\n") for name in MODULES.split()),
        *(put(f"{folder}/train.yaml", EVIL) for folder in (".", "conf", ".hydra", "uarm_rl/conf")),
        put(".hydra/config.yaml", EVIL),
        put(".hydra/overrides.yaml", f"- hydra.callbacks.x._target_={PAYLOAD}.Callback\n"),
        put("matplotlibrc", STYLE),
        put("pyvenv.cfg", "home = OUTSIDE\n"),
    )
    for words in (("train", "-m", *TINY), EVALUATE, REPORT):
        yield Case("start in a hostile folder", " ".join(words[:2]), words, traps, accepted=True)


def cases() -> Iterator[Case]:
    """Every hostile command line, environment and working directory."""
    for make in (overrides, surroundings, starts):
        yield from make()
