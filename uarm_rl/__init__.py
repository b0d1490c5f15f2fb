"""uarm-rl: train a uArm Swift Pro to reach and suck objects, in simulation and on the desk."""

__version__ = "0.1.0"


def register_environments() -> None:
    """Register ``uarm_rl/UArmSuction-v0``; Gymnasium calls this through the package's entry point."""
    from gymnasium.envs.registration import register

    register(id="UArmSuction-v0", entry_point="uarm_rl.cli:make_env")
