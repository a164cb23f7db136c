"""Fine-tuning a network to one garment: by the physics of its cloth, or by simulations of it."""

import dataclasses
import functools
import pathlib
import shutil
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jaxtyping import Array, Float, Int

from ..body import Body, load_body
from ..errors import MotionError, PhysXNetError, WeightsError, check_counts, check_numbers
from ..files import atomic_write
from ..garment import Garment
from ..geometry import pad_rows, patch_shares
from ..models import (
    BoundGarment,
    Generator,
    Predictor,
    apply_sampled_offsets,
    clip_features,
    load_predictor,
    make_generator,
    normalise,
)
from ..motion import (
    BLOCK,
    CLIPS,
    Motion,
    clip_transforms,
    history_transforms,
    padded_block,
    prepare_motion,
)
from ..simulation import (
    PRESETS,
    PreparedScene,
    Solver,
    System,
    fingerprint,
    incremental_potential,
    make_system,
    prepare_scene,
    simulate_batch,
)
from ..typing import pytree
from ..uv import condition_maps
from ._dresser import bind_to_predictor, move_to_body, with_body
from ._meshes import resolve_garments
from ._simulate import Simulation, build_scene
from .postprocess import BodyCollider, Outfit, apply_collisions, make_colliders

_FPS = 30.0
# Distance between the middles of patches [m].
_PATCH = 0.08
# Errors and sinking are relative to this length, energies to lifting the garment by it [m].
_LENGTH = 0.01
# Stiffness of contact per mass [1/s^2].
_CONTACT = (2.0 * np.pi * 30.0) ** 2
# Weights of the potential, without and with simulations.
_WEIGHTS = (0.002, 0.0003)


@dataclasses.dataclass(frozen=True, kw_only=True)
class AdaptConfig:
    """Settings of `adapt`.

    Attributes:
        steps: Steps of Adam.
        windows: Windows of successive frames in a step.
        frames: Frames of a window, of which the first two have no past.
        learning_rate: Adam's learning rate; it decays to zero along a cosine.
        potential: Weight of the cloth's potential; by default 0.002, or 0.0003 with simulations,
            which are nearer the truth than what lowers the potential most.
        validate_every: Steps between validations on the clip that is held out.
        seed: Seed of the choice of windows.
    """

    steps: int = 1000
    windows: int = 2
    frames: int = 6
    learning_rate: float = 1e-3
    potential: float | None = None
    validate_every: int = 100
    seed: int = 0

    def __post_init__(self) -> None:
        check_counts(self, "steps", "windows", "frames", "validate_every")
        check_numbers(self, "learning_rate")
        check_numbers(self, "potential", zero=True)
        if self.frames < 3:
            raise ValueError(f"frames is {self.frames}; a window needs three for accelerations.")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Adapted:
    """A network that was fine-tuned to a garment.

    Attributes:
        predictor: The network; the one that was given if none did better.
        garment: The garment.
        loss: Loss on the held-out clip before and after.
        potential: Potential of the cloth there, mean over frames, before and after [J].
        rmse_mm: Distance there from the simulation, before and after [mm]; None without one.
        steps: Steps after which the network was best.
        seconds: Time of learning, and of simulations [s].
    """

    predictor: Predictor
    garment: Garment
    loss: tuple[float, float]
    potential: tuple[float, float]
    rmse_mm: tuple[float, float] | None
    steps: int
    seconds: tuple[float, float]


def adapt(
    garment: Garment | str | pathlib.Path,
    *,
    weights: Predictor | str | pathlib.Path = "base",
    motions: Sequence[Motion | str | pathlib.Path] = (),
    held_out: Motion | str | pathlib.Path = "punch",
    shape: Float[Array, " shapes"] | None = None,
    simulate: bool = False,
    frames: int | None = None,
    config: AdaptConfig | None = None,
    progress: Callable[[str, int, int], None] | None = None,
    resume: str | pathlib.Path | None = None,
) -> Adapted:
    """Fine-tunes the decoder of a garment's template to that garment, fabric and body.

    Without simulations the network learns to lower the potential of its own cloth
    (`incremental_potential`, and contact with the skin); means over patches of 8 cm stay where
    it predicted them: the potential knows no friction, so that cloth would slide off. With
    ``simulate`` it learns from simulations of the garment at ``standard``, and from the potential.

    Args:
        garment: The garment, a file, or a name with options such as ``coat.obj:fabric=wool``.
        weights: The network to start from.
        motions: Motions to learn from, beside the built-in clips.
        held_out: Motion by which the best network is chosen.
        shape: Shape parameters of the body; the default if None.
        simulate: Whether to simulate the garment on all motions first.
        frames: Use at most so many frames of each motion; a thousand take 0.3 GB of memory.
        config: Settings; defaults if None.
        progress: Called with the stage, what is done and the total.
        resume: Folder for what is finished, from which the same call goes on after an
            interruption; it is removed at the end. If None, nothing is stored.

    Returns:
        The network and what it gained. Its other decoders and its encoder are unchanged.

    Raises:
        PhysXNetError: The garment can't be worn by this network, a motion can't be read, or the
            folder to resume from belongs to another call.
        WeightsError: The network isn't a `Generator` as it was loaded, but folded, say.

    References:
        Santesteban et al., SNUG (2022); Grigorev et al., HOOD (2023).
    """
    config = AdaptConfig() if config is None else config
    report = (lambda *_: None) if progress is None else progress
    began = time.perf_counter()
    body = load_body()
    rest = body.rest_vertices(body.default_shape() if shape is None else shape)
    (worn,), _ = resolve_garments(garment, body, shape)
    worn = move_to_body(body, worn)
    predictor = load_predictor(weights) if not isinstance(weights, Predictor) else weights
    predictor = with_body(predictor, body, rest)
    _check_plain(predictor)
    names = [n for n in CLIPS if n != held_out]
    clips = [
        prepare_motion(m, fps=_FPS, body=body, shape=shape, frames=frames)
        for m in (*names, *motions, held_out)
    ]
    if short := [m.name for m in clips if m.num_frames < config.frames]:
        raise MotionError(f"{short[0]} is shorter than a window of {config.frames} frames.")
    scene = prepare_scene(build_scene([worn], body, shape, Simulation()))
    solver = PRESETS["standard"]
    folder = None
    if resume is not None:
        call = (predictor.state, scene.effects, scene.inverse_mass, clips, np.asarray(rest))
        folder = _claim(pathlib.Path(resume), fingerprint(*call), config, simulate)
    truth = _simulated(scene, clips, solver, folder, report) if simulate else None
    simulated = time.perf_counter() - began
    system = make_system(scene, solver)
    task, first = _make_task(predictor, body, rest, worn, system, config, simulate)
    data = [_encode(task, first, m, body, rest) for m in clips]
    if truth is not None:
        data = [dataclasses.replace(d, target=x) for d, x in zip(data, truth, strict=True)]
    best, steps = _learn(task, first, data[:-1], data[-1], folder, report)
    if folder is not None:
        shutil.rmtree(folder)
    before, after = (_judge(task, p, data[-1]) for p in (first, best))
    return Adapted(
        predictor=dataclasses.replace(predictor, state=nnx.merge_state(best, task.others)),
        garment=worn,
        loss=(before["loss"], after["loss"]),
        potential=(before["potential"], after["potential"]),
        rmse_mm=(before["rmse_mm"], after["rmse_mm"]) if simulate else None,
        steps=steps,
        seconds=(time.perf_counter() - began - simulated, simulated if simulate else 0.0),
    )


def _check_plain(predictor: Predictor) -> None:
    network = nnx.merge(predictor.graph, predictor.state)
    if isinstance(network, Generator) and not predictor.mirror_tta:
        plain = nnx.eval_shape(lambda: make_generator(predictor.config))
        if jax.tree.structure(nnx.state(plain)) == jax.tree.structure(nnx.state(network)):
            return
    raise WeightsError("adapt needs a network as it was loaded, without anything added to it.")


def _claim(folder: pathlib.Path, call: str, config: AdaptConfig, simulate: bool) -> pathlib.Path:
    """Makes a folder for unfinished work, or finds that of the same call."""
    key = f"{call} {config} simulate={simulate}"
    label = folder / "key.txt"
    if label.is_file() and label.read_text() != key:
        raise PhysXNetError(
            f"{folder} holds unfinished work on another garment or with other settings. Finish"
            " that, or remove the folder."
        )
    if not label.is_file() and folder.is_dir() and any(folder.iterdir()):
        raise PhysXNetError(f"{folder} holds other files. Choose an empty or a new folder.")
    with atomic_write(label) as part:
        part.write_text(key)
    return folder


def _simulated(
    scene: PreparedScene,
    clips: list[Motion],
    solver: Solver,
    folder: pathlib.Path | None,
    report: Callable[[str, int, int], None],
) -> list[Float[np.ndarray, "frames vertices 3"]]:
    """The garment as it is simulated on each clip [m]."""
    stored = None if folder is None else folder / "simulations.npz"
    if stored is not None and stored.is_file():
        with np.load(stored) as known:
            return [known[str(k)] for k in range(len(clips))]
    rollouts = simulate_batch(
        scene,
        clips,
        solver=solver,
        progress=lambda k, n: report("simulation", k, n),
        resume=None if folder is None else folder / "simulation",
    )
    for r in rollouts:
        r.check()
    cloth = [r.positions[0] for r in rollouts]
    if stored is not None:
        with atomic_write(stored) as part, part.open("wb") as file:
            np.savez(file, **{str(k): x for k, x in enumerate(cloth)})  # pyright: ignore
    return cloth


@pytree
@dataclasses.dataclass(frozen=True, kw_only=True)
class _Learned:
    """What changes while a network learns.

    Attributes:
        params: Parameters.
        memory: State of the optimizer.
        best: The parameters that did best on the held-out clip.
        least: Their loss there.
        best_step: Their step.
        step: Steps done.
    """

    params: Any
    memory: Any
    best: Any
    least: Array
    best_step: Array
    step: Array


@pytree
@dataclasses.dataclass(frozen=True, kw_only=True)
class _Task:
    """What a step needs beside the parameters that learn.

    Attributes:
        predictor: The network as it was.
        others: Its parameters and statistics that stay.
        bound: The garment on the body.
        conditions: What the network sees of the garment; None if it sees nothing.
        system: The cloth's physics.
        collider: The skin near the garment.
        index: Vertices of each patch, shape [patches, k].
        share: Their shares in its mean, shape [patches, k].
        mass: Masses of vertices [kg], shape [vertices].
        config: Settings.
        simulated: Whether there are simulations to learn from.
    """

    predictor: Predictor
    others: Any
    bound: BoundGarment
    conditions: Float[Array, "height width channels"] | None
    system: System
    collider: BodyCollider
    index: Int[Array, "patches k"]
    share: Float[Array, "patches k"]
    mass: Float[Array, " vertices"]
    config: AdaptConfig = dataclasses.field(metadata={"static": True})
    simulated: bool = dataclasses.field(metadata={"static": True})


@pytree
@dataclasses.dataclass(frozen=True, kw_only=True)
class _Frames:
    """Frames to learn from.

    Attributes:
        features: What the encoder makes of the motion, finest first; the frame is the first axis.
        rotations: World rotations of joints, shape [frames, joints, 3, 3].
        translations: World translations of joints [m], shape [frames, joints, 3].
        target: Where the cloth should be [m], shape [frames, vertices, 3].
    """

    features: list[Any]
    rotations: Any
    translations: Any
    target: Any

    def take(self, rows: slice | np.ndarray) -> "_Frames":
        """Some of the frames."""
        return jax.tree.map(lambda x: x[rows], self)


def _make_task(
    predictor: Predictor,
    body: Body,
    rest: Float[Array, "all 3"],
    worn: Garment,
    system: System,
    config: AdaptConfig,
    simulated: bool,
) -> tuple[_Task, Any]:
    """The task, and the parameters that learn as they are at first."""
    bound = bind_to_predictor(predictor, body, rest, worn)
    (collider,) = make_colliders(Outfit(body, rest, (bound,), (worn,)))
    conditions = None
    if predictor.config.conditions:
        base = body.rest_vertices(body.default_shape())
        conditions = condition_maps(predictor.atlas, body, base, worn, bound.binding)
    vertices, faces = np.asarray(worn.mesh.vertices), np.asarray(worn.mesh.faces)
    index, share = pad_rows(patch_shares(vertices, faces, _PATCH).T.tocsr())
    learns, others = nnx.split_state(predictor.state, _decoder_of(worn.template), ...)
    inverse = system.inverse_mass[:, 0, 0]
    task = _Task(
        predictor=predictor,
        others=others,
        bound=bound,
        conditions=conditions,
        system=system,
        collider=collider,
        index=jnp.asarray(index),
        share=jnp.asarray(share / share.sum(axis=1, keepdims=True)),
        mass=jnp.where(inverse > 0, 1.0 / jnp.where(inverse > 0, inverse, 1.0), 0.0),
        config=config,
        simulated=simulated,
    )
    return task, learns


def _decoder_of(template: str) -> Callable[[tuple, Any], bool]:
    """Selects the parameters of one decoder."""

    def chosen(path: tuple, value: Any) -> bool:
        return tuple(path[:2]) == ("decoders", template) and isinstance(value, nnx.Param)

    return chosen


def _network(task: _Task, params: Any) -> Any:
    network = nnx.merge(task.predictor.graph, nnx.merge_state(params, task.others))
    network.eval()
    return network


def _cloth(task: _Task, params: Any, frames: _Frames) -> Float[Array, "frames vertices 3"]:
    """The garment as a network of these parameters predicts it [m]."""
    predictor, bound, network = task.predictor, task.bound, _network(task, params)
    known = None
    if task.conditions is not None:
        known = network.modulation(bound.template, task.conditions[None])
    features = [f.astype(jnp.float32) for f in frames.features]
    maps = network.decode(bound.template, features, known)
    scale, valid = (
        x[bound.template] for x in (predictor.normalisation.offset, predictor.texel_points.valid)
    )
    offsets = jnp.where(valid[None, :, None], scale * predictor.atlas.from_map(maps), 0.0)
    place = functools.partial(apply_sampled_offsets, bound, family=predictor.config.family)
    return jax.vmap(place)(frames.rotations, frames.translations, bound.sample(offsets))


def _loss(
    task: _Task, params: Any, frames: _Frames
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """The loss of some windows, and what it consists of."""
    config = task.config
    x = _cloth(task, params, frames)
    away = x - frames.target
    means = jnp.einsum("pk,fpkc->fpc", task.share, away[:, task.index])
    error = jnp.mean(jnp.abs(means)) / _LENGTH
    if task.simulated:
        error = 0.5 * error + 0.5 * jnp.mean(jnp.abs(away)) / _LENGTH
    (pushed,) = apply_collisions(
        (task.collider,), (jax.lax.stop_gradient(x),), frames.rotations, frames.translations
    )
    sunk = jnp.sum((x - jax.lax.stop_gradient(pushed)) ** 2, axis=2)
    contact = 0.5 * _CONTACT * jnp.mean(jnp.sum(task.mass[None] * sunk, axis=1))
    # Frames of a window become the batch: a frame moves on from the two before it, as they are.
    window = x.reshape(-1, config.frames, *x.shape[1:])
    older, before = (
        jax.lax.stop_gradient(_as_batch(window[:, k : config.frames - 2 + k])) for k in range(2)
    )
    energy = incremental_potential(
        task.system, _as_batch(window[:, 2:]), before, _FPS * (before - older), length=1.0 / _FPS
    )
    potential = jnp.mean(energy) + contact
    lift = 9.81 * _LENGTH * jnp.sum(task.mass)
    weight = _WEIGHTS[task.simulated] if config.potential is None else config.potential
    total = error + weight * potential / lift
    squared = jnp.mean(jnp.sum(away**2, axis=2))
    return total, {"loss": total, "potential": potential, "squared": squared}


def _as_batch(
    window: Float[Array, "windows frames vertices 3"],
) -> Float[Array, "vertices 3 batch"]:
    return jnp.moveaxis(window.reshape(-1, *window.shape[2:]), 0, -1)


@functools.partial(jax.jit, static_argnames="optimizer")
def _step(
    task: _Task, params: Any, memory: Any, frames: _Frames, optimizer: optax.GradientTransformation
) -> tuple[Any, Any]:
    """One step of the optimizer."""
    slopes = jax.grad(lambda p: _loss(task, p, frames)[0])(params)
    # optax raises floats to integer powers, which strict promotion forbids.
    with jax.numpy_dtype_promotion("standard"):
        changes, memory = optimizer.update(slopes, memory, params)
    return optax.apply_updates(params, changes), memory


@jax.jit
def _measure(task: _Task, params: Any, frames: _Frames) -> dict[str, Array]:
    return _loss(task, params, frames)[1]


def _judge(task: _Task, params: Any, clip: _Frames) -> dict[str, float]:
    """Loss, potential [J] and RMSE [mm] on a clip, window by window."""
    size = task.config.frames
    starts = range(0, len(clip.target) - size + 1, size)
    found = [_measure(task, params, clip.take(slice(s, s + size))) for s in starts]
    mean = {k: float(np.mean([float(f[k]) for f in found])) for k in found[0]}
    return {**mean, "rmse_mm": 1e3 * mean["squared"] ** 0.5}


def _encode(
    task: _Task, params: Any, clip: Motion, body: Body, rest: Float[Array, "all 3"]
) -> _Frames:
    """A clip as frames to learn from, whose cloth should stay where it is predicted."""
    history = task.predictor.config.inputs.at_rate(_FPS).window - 1
    r, t = clip_transforms(body, rest, clip)
    before = history_transforms(body, rest, clip, history)
    r, t = (np.concatenate(pair) for pair in zip(before, (r, t), strict=True))
    count, parts = clip.num_frames, []
    for start in range(0, count, BLOCK):
        padded = (jnp.asarray(padded_block(x, start + history, history)) for x in (r, t))
        made = _encode_block(task, params, *padded)
        parts.append(jax.tree.map(np.asarray, made))
    return jax.tree.map(lambda *x: np.concatenate(x)[:count], *parts)


@jax.jit
def _encode_block(task: _Task, params: Any, rotations: Array, translations: Array) -> _Frames:
    predictor, inputs = task.predictor, task.predictor.config.inputs
    points = predictor.texel_points
    features = clip_features(points.rest, points.weights, rotations, translations, _FPS, inputs)
    maps = predictor.motion_atlas.to_map(normalise(features, predictor.normalisation, inputs))
    first = inputs.at_rate(_FPS).window - 1
    # Half precision: the features of a thousand frames are in memory.
    features = [f.astype(jnp.float16) for f in _network(task, params).encode(maps)]
    frames = _Frames(
        features=features,
        rotations=rotations[first:],
        translations=translations[first:],
        target=None,
    )
    return dataclasses.replace(frames, target=_cloth(task, params, frames))


def _learn(
    task: _Task,
    params: Any,
    clips: list[_Frames],
    held_out: _Frames,
    folder: pathlib.Path | None,
    report: Callable[[str, int, int], None],
) -> tuple[Any, int]:
    """The parameters that did best on the held-out clip, and the steps they took."""
    config = task.config
    room = np.array([len(c.target) - config.frames + 1 for c in clips])
    rate = optax.cosine_decay_schedule(config.learning_rate, config.steps)
    optimizer = optax.apply_if_finite(optax.adam(rate), config.steps)
    now = _Learned(
        params=params,
        memory=optimizer.init(params),
        best=params,
        least=jnp.asarray(_judge(task, params, held_out)["loss"]),
        best_step=jnp.zeros((), jnp.int32),
        step=jnp.zeros((), jnp.int32),
    )
    checkpoints = None
    if folder is not None:
        # Orbax takes a second to import.
        from ..training import Checkpoints

        checkpoints = Checkpoints(folder / "checkpoints", keep=1)
        now = checkpoints.latest(now) or now
    for step in range(int(now.step) + 1, config.steps + 1):
        # A stream of each step's own: a resumed run draws the same.
        rng = np.random.default_rng((config.seed, step))
        drawn = rng.choice(len(clips), config.windows, p=room / room.sum())
        taken = []
        for c in drawn:
            start = rng.integers(room[c])
            taken.append(clips[c].take(slice(start, start + config.frames)))
        frames = jax.tree.map(lambda *x: jnp.asarray(np.concatenate(x)), *taken)
        params, memory = _step(task, now.params, now.memory, frames, optimizer)
        now = dataclasses.replace(now, params=params, memory=memory, step=jnp.int32(step))
        if step % config.validate_every == 0 or step == config.steps:
            loss = jnp.asarray(_judge(task, params, held_out)["loss"])
            if loss < now.least:
                now = dataclasses.replace(now, best=params, least=loss, best_step=now.step)
            if checkpoints is not None:
                checkpoints.save(now)
        report("steps", step, config.steps)
    if checkpoints is not None:
        checkpoints.close()
    return now.best, int(now.best_step)
