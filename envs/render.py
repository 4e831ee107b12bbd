"""Segments as pictures, drawn again from their simulator states: nothing is rendered while a policy acts."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache, partial
from importlib import import_module
from types import MappingProxyType
from typing import Any

import gymnasium
import numpy as np
from PIL import Image, ImageOps

from prefrl.envs.fast.wrapped import is_mujoco, make
from prefrl.envs.pictures import BLUE, acrobot, cartpole, finished, mountain_car, pendulum, stroke
from prefrl.types import Floats, Segment

INSTALL = "apt-get install -y libegl1 libgl1-mesa-dri"


def frames(name: str, segment: Segment, size: int, options: Mapping[str, Any] = MappingProxyType({})) -> np.ndarray:
    """(T, size, size, 3) uint8 pictures of a segment of the environment `name`, which is made with `options`.

    Raises ValueError where the segment keeps no states, and RuntimeError where there is no OpenGL for MuJoCo.
    """
    if segment.states is None:
        raise ValueError(
            f"{name} cannot be drawn: its simulator gives no states to draw from. Classic control and MuJoCo "
            "environments can be, and one of your own that has get_state() and set_state(state)"
        )
    draw = _CLASSIC.get(name.split("-")[0])
    if draw is None and "mujoco" in str(gymnasium.registry[name].entry_point):
        return _mujoco(make(name, disable_env_checker=True, **options), segment.states, size)
    if draw is None:
        return _own(make(name, render_mode="rgb_array", disable_env_checker=True, **options), segment.states, size)
    steps = zip(segment.states, segment.actions, strict=True)
    return np.stack([finished(draw(state, action, size)) for state, action in steps])


def _pendulum(state: Floats, action: Floats, size: int) -> Floats:
    """The bar below shows the torque, from its middle."""
    picture, torque = pendulum(state, size), np.clip(action[0] / 2.0, -1.0, 1.0)
    stroke(picture, (0.0, -1.3), (-torque, -1.3), 0.03, BLUE)
    return picture


def _still(draw: Callable[[Floats, int], Floats], state: Floats, action: Floats, size: int) -> Floats:
    """A picture that shows nothing of the action."""
    return draw(state, size)


_CLASSIC: dict[str, Callable[[Floats, Floats, int], Floats]] = {
    "Pendulum": _pendulum,
    "CartPole": partial(_still, cartpole),
    "Acrobot": partial(_still, acrobot),
    "MountainCar": partial(_still, partial(mountain_car, goal=0.5)),
    "MountainCarContinuous": partial(_still, partial(mountain_car, goal=0.45)),
}
"""By what gymnasium's id begins with."""


def _own(env: gymnasium.Env[Any, Any], states: Floats, size: int) -> np.ndarray:
    """Pictures that the environment draws itself, brought into one state after another; what is not square gets edges.

    A subclass of MuJoCo's environments, registered elsewhere, is drawn as MuJoCo's are.
    """
    if is_mujoco(env):
        return _mujoco(env, states, size)
    own: Any = env.unwrapped
    pictures = []
    try:
        env.reset(seed=0)
        for state in states:
            own.set_state(state)
            picture = Image.fromarray(np.asarray(own.render(), np.uint8))
            pictures.append(np.asarray(ImageOps.pad(picture, (size, size), color="white")))
    finally:
        env.close()
    return np.stack(pictures)


# --- MuJoCo -------------------------------------------------------------------------------------------------------
# Not mujoco.Renderer: which OpenGL that uses hangs on an environment variable read when it is first imported.


def _mujoco(made: gymnasium.Env[Any, Any], states: Floats, size: int) -> np.ndarray:
    import mujoco

    with _context(size):
        env = _set_up(made, size)
        scene, option, data = mujoco.MjvScene(env.model, 1000), mujoco.MjvOption(), mujoco.MjData(env.model)
        camera, view = _camera(env), mujoco.MjrRect(0, 0, size, size)
        graphics_ = mujoco.MjrContext(env.model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, graphics_)
        # Without a GPU, shadows and reflections cost more than all the rest.
        scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        pictures = np.empty((len(states), size, size, 3), np.uint8)
        for picture, state in zip(pictures, states, strict=True):
            mujoco.mj_setState(env.model, data, state, mujoco.mjtState.mjSTATE_PHYSICS)
            mujoco.mj_forward(env.model, data)
            mujoco.mjv_updateScene(env.model, data, option, None, camera, mujoco.mjtCatBit.mjCAT_ALL, scene)
            mujoco.mjr_render(view, scene, graphics_)
            mujoco.mjr_readPixels(picture, None, view, graphics_)
        graphics_.free()
    return pictures[:, ::-1]  # OpenGL's first row is the lowest


def _set_up(made: gymnasium.Env[Any, Any], size: int) -> Any:
    """The environment, its model set up for fast drawing; before the OpenGL context's buffers are made."""
    env: Any = made.unwrapped
    visual = env.model.vis
    visual.quality.offsamples = visual.quality.shadowsize = 0
    visual.global_.offwidth, visual.global_.offheight = size, size
    return env


def _camera(env: Any) -> Any:
    """The environment's usual camera, which follows the body; without one, gymnasium's, from above the middle."""
    import mujoco

    camera = mujoco.MjvCamera()
    camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FREE, -1
    mujoco.mj_forward(env.model, env.data)
    # Not the model's centre, which a floor far below draws down until the body is out of the picture.
    camera.lookat[:] = np.median(env.data.geom_xpos, axis=0)
    camera.distance = env.model.stat.extent
    named = mujoco.mj_name2id(env.model, mujoco.mjtObj.mjOBJ_CAMERA, "track")
    if named >= 0:
        camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, named
    return camera


@contextmanager
def _context(size: int) -> Iterator[None]:
    """An OpenGL context without a screen. Raises RuntimeError where there is none."""
    found = graphics()
    if found is None:
        raise RuntimeError(f"drawing MuJoCo needs OpenGL: run `{INSTALL}`")
    try:
        context = import_module(f"mujoco.{found}").GLContext(size, size)
        context.make_current()
    except Exception as error:  # PyOpenGL raises many kinds of its own
        raise RuntimeError(f"OpenGL by {found} does not start ({error}); run `{INSTALL}`") from error
    try:
        yield
    finally:
        context.free()


@cache
def graphics() -> str | None:
    """Which OpenGL there is: "egl" or "osmesa" on Linux, "cgl" or "glfw" elsewhere; None where there is none."""
    if sys.platform != "linux":
        return "cgl" if sys.platform == "darwin" else "glfw"
    libraries = {"egl": ("libEGL.so.1",), "osmesa": ("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so")}
    return next((name for name, files in libraries.items() if any(map(_loads, files))), None)


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True
