"""Registration of the environments with Gymnasium: ``gymnasium.make("hypogoal.envs:hypogoal/DoorKey-8x8-v0")``.

An environment's module is loaded when the environment is made. Since 1.0 Gymnasium asks no entry points of installed
packages. So a user who wants an environment imports a package, or names a module before the id.
"""

from gymnasium import register

register(id="hypogoal/DoorKey-8x8-v0", entry_point="hypogoal.domains.doorkey.env:DoorKeyEnv")
register(id="hypogoal/MontezumaLadder-v0", entry_point="hypogoal.domains.montezuma.env:MontezumaLadder")
