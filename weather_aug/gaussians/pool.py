"""The Gaussians while they are fitted: torch parameters and Adam's state, row by row.

A row is one Gaussian. Rows may be replaced, appended and left out between steps; whatever belongs
to a row goes along with it: its parameters, what Adam remembers of them, and its constants.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from weather_aug._checks import finite
from weather_aug.errors import ArgumentError, DataError, printable
from weather_aug.gaussians.types import Gaussians

RATES: Mapping[str, float] = MappingProxyType(
    {
        "means_m": 1.6e-4,
        "quaternions": 1e-3,
        "log_scales": 5e-3,
        "logit_opacities": 0.05,
        "sh_dc": 2.5e-3,
        "sh_rest": 1.25e-4,
    }
)
"""Default learning rates, those of 3DGS and gsplat; that of `means_m` is for a radius of 1 m, see
`position_rate`."""
FIRST_POSITION_RATE, LAST_POSITION_RATE = 1.6e-4, 1.6e-6
EPSILON = 1e-15
"""Of Adam: gradients of Gaussians are small, and the usual 1e-8 would hold them back."""
_MOMENTS = ("exp_avg", "exp_avg_sq")


def position_rate(step: int, steps: int, radius_m: float) -> float:
    """Learning rate of `means_m` at a step, metres: from 1.6e-4 to 1.6e-6 of the scene's radius.

    The logarithm of the rate falls evenly over `steps`; after them the rate stays.

    Raises:
        ArgumentError: If `steps` or `radius_m` is not positive, or `step` is negative.

    Sources:
        3DGS (Kerbl et al. 2023), the released schedule.
    """
    share = finite("step", step, 0) / finite("steps", steps, 1)
    ratio = LAST_POSITION_RATE / FIRST_POSITION_RATE
    return finite("radius_m", radius_m, 1e-9) * FIRST_POSITION_RATE * ratio ** min(share, 1.0)


class Pool:
    """N Gaussians under optimisation by Adam.

    Convention:
        `parameters` are leaves of autograd, float32, of the shapes in `Gaussians`, with the
        coefficients of the colours apart: `sh_dc` (N, 1, 3) and `sh_rest` (N, K-1, 3). After
        `append`, `keep` and `restore` they are new objects: fetch them anew for each step.
        `constants` are (N, …) tensors of any type which are not fitted. Nothing here draws random
        numbers.

    Args:
        parameters: By name; all with the same number of rows.
        rates: Learning rate by name, one for each parameter.
        constants: By name.

    Raises:
        ArgumentError: If rows disagree, a parameter has no rate, or a name is used twice.
    """

    def __init__(
        self,
        parameters: Mapping[str, Tensor],
        rates: Mapping[str, float],
        constants: Mapping[str, Tensor] | None = None,
    ) -> None:
        constants = dict(constants or {})
        if not parameters or set(parameters) != set(rates):
            raise ArgumentError(
                f"rates must name the parameters {sorted(parameters)}, got {sorted(rates)}"
            )
        if set(parameters) & set(constants):
            raise ArgumentError(
                f"{sorted(set(parameters) & set(constants))} are parameters and constants; "
                "each name may be used once"
            )
        count = len(next(iter(parameters.values())))
        for name, value in {**parameters, **constants}.items():
            if value.ndim == 0 or len(value) != count:
                raise ArgumentError(f"{name} must have {count} rows, got {tuple(value.shape)}")
        self.parameters = {
            name: torch.nn.Parameter(value.detach().float().clone(memory_format=_FORMAT))
            for name, value in parameters.items()
        }
        self.constants = {name: value.detach().clone() for name, value in constants.items()}
        groups: list[dict[str, Any]] = [
            {"params": [value], "lr": finite(f"rates[{name!r}]", rates[name], 0), "name": name}
            for name, value in self.parameters.items()
        ]
        self._adam = torch.optim.Adam(groups, eps=EPSILON, fused=True)
        for value in self.parameters.values():
            # Before the first step already, so that rows can be changed at any time.
            self._adam.state[value] = {
                "step": torch.zeros((), device=value.device),
                "exp_avg": torch.zeros_like(value),
                "exp_avg_sq": torch.zeros_like(value),
            }

    @classmethod
    def of(
        cls,
        gaussians: Gaussians,
        rates: Mapping[str, float] | None = None,
        *,
        more: Mapping[str, Any] | None = None,
        device: torch.device | str = "cpu",
        **constants: Any,
    ) -> Pool:
        """Pool of `gaussians`.

        Args:
            gaussians: Where the fit starts; their class scores are not fitted here.
            rates: Learning rates that differ from `RATES`, and those of `more`.
            more: Further parameters, (N, …) by name.
            device: Where the tensors live.
            **constants: (N, …) rows that go along without being fitted.

        Raises:
            ArgumentError: See the class.
        """
        values = {
            "means_m": gaussians.means_m,
            "quaternions": gaussians.quaternions,
            "log_scales": gaussians.log_scales,
            "logit_opacities": gaussians.logit_opacities,
            "sh_dc": gaussians.sh[:, :1],
            "sh_rest": gaussians.sh[:, 1:],
            **(more or {}),
        }
        return cls(
            {name: torch.as_tensor(value, device=device) for name, value in values.items()},
            {**RATES, **(rates or {})},
            {name: torch.as_tensor(value, device=device) for name, value in constants.items()},
        )

    @classmethod
    def of_state(cls, state: Mapping[str, Tensor], device: torch.device | str = "cpu") -> Pool:
        """Pool that goes on, to the bit, where `state` was taken.

        Raises:
            DataError: If `state` is not what `Pool.state` gives.
        """
        try:
            names = [name.partition(".")[2] for name in state if name.startswith("parameters.")]
            pool = cls(
                {name: state[f"parameters.{name}"].to(device) for name in names},
                {name: float(state[f"rates.{name}"]) for name in names},
                {
                    name.partition(".")[2]: value.to(device)
                    for name, value in state.items()
                    if name.startswith("constants.")
                },
            )
            for name, value in pool.parameters.items():
                memory = pool._adam.state[value]
                for key, kept in memory.items():
                    kept.copy_(_same_shape(state[f"{key}.{name}"], kept, f"{key}.{name}"))
        except (ArgumentError, KeyError, ValueError) as error:
            raise DataError(
                f"the state of a fit is damaged: {type(error).__name__} {printable(error)}; "
                "start the fit anew"
            ) from None
        return pool

    def __len__(self) -> int:
        return len(self.parameters["means_m"])

    @property
    def rates(self) -> dict[str, float]:
        """Learning rate of each parameter."""
        return {group["name"]: float(group["lr"]) for group in self._adam.param_groups}

    @property
    def scales_m(self) -> Tensor:
        """(N, 3) standard deviations, metres; with gradient."""
        return self.parameters["log_scales"].exp()

    @property
    def opacities(self) -> Tensor:
        """(N,) in 0..1; with gradient."""
        return self.parameters["logit_opacities"].sigmoid()

    @property
    def sh(self) -> Tensor:
        """(N, K, 3) coefficients of the colours; with gradient."""
        return torch.cat([self.parameters["sh_dc"], self.parameters["sh_rest"]], dim=1)

    def set_rate(self, name: str, rate: float) -> None:
        """Set the learning rate of one parameter, at least 0.

        Raises:
            ArgumentError: If there is no such parameter, or the rate is negative.
        """
        for group in self._adam.param_groups:
            if group["name"] == name:
                group["lr"] = finite("rate", rate, 0)
                return
        raise ArgumentError(f"no parameter {name!r}; there are {sorted(self.parameters)}")

    def step(self) -> None:
        """One step of Adam along the gradients; parameters without one stay as they are."""
        self._adam.step()

    def zero_grad(self) -> None:
        """Forget the gradients."""
        self._adam.zero_grad(set_to_none=True)

    @torch.no_grad()
    def replace(
        self,
        rows: Tensor,
        values: Mapping[str, Tensor],
        constants: Mapping[str, Tensor] | None = None,
    ) -> None:
        """Set rows of some parameters and constants, in place.

        What Adam remembers of the parameters named becomes 0 in these rows: it belongs to what was
        there before. All other parameters keep their rows and memory.

        Args:
            rows: (R,) int64, each at most once.
            values: (R, …) by name of the parameter.
            constants: (R, …) by name of the constant.

        Raises:
            ArgumentError: If a name is unknown or a shape does not fit.
        """
        constants = constants or {}
        for given, kept in ((values, self.parameters), (constants, self.constants)):
            _check_rows(given, kept, len(rows), given.keys())
        for name, value in values.items():
            parameter = self.parameters[name]
            parameter[rows] = value.to(parameter)
            for moment in _MOMENTS:
                self._adam.state[parameter][moment][rows] = 0.0
        for name, value in constants.items():
            self.constants[name][rows] = value.to(self.constants[name])

    @torch.no_grad()
    def append(
        self, values: Mapping[str, Tensor], constants: Mapping[str, Tensor] | None = None
    ) -> None:
        """Add rows at the end; Adam remembers nothing of them.

        Args:
            values: (R, …) of every parameter.
            constants: (R, …) of every constant.

        Raises:
            ArgumentError: If a name is missing or unknown, or a shape does not fit.
        """
        constants = constants or {}
        added = len(values["means_m"]) if "means_m" in values else 0
        _check_rows(values, self.parameters, added, self.parameters)
        _check_rows(constants, self.constants, added, self.constants)

        def longer(name: str, old: Tensor) -> Tensor:
            return torch.cat([old, values[name].to(old)])

        def with_zeros(name: str, old: Tensor) -> Tensor:
            return torch.cat([old, old.new_zeros((added, *old.shape[1:]))])

        self._rebuild(longer, with_zeros)
        for name, kept in self.constants.items():
            self.constants[name] = torch.cat([kept, constants[name].to(kept)])

    @torch.no_grad()
    def keep(self, mask: Tensor) -> None:
        """Leave out the rows where `mask` (N,) bool is False; the others keep their order.

        Raises:
            ArgumentError: If `mask` is not (N,) bool.
        """
        if mask.shape != (len(self),) or mask.dtype != torch.bool:
            raise ArgumentError(
                f"mask must be bool ({len(self)},), got {mask.dtype} {tuple(mask.shape)}"
            )

        def kept_of(name: str, old: Tensor) -> Tensor:
            return old[mask]

        self._rebuild(kept_of, kept_of)
        self.constants = {name: value[mask] for name, value in self.constants.items()}

    def gaussians(self, class_scores: np.ndarray[Any, Any] | None = None) -> Gaussians:
        """Copy as plain arrays; parameters beyond those of `Gaussians` are left out.

        Args:
            class_scores: (N, C); none if None.
        """
        with torch.no_grad():
            sh = _array(self.sh)
        if class_scores is None:
            class_scores = np.zeros((len(self), 0), np.float16)
        return Gaussians(
            means_m=_array(self.parameters["means_m"]),
            quaternions=_array(self.parameters["quaternions"]),
            log_scales=_array(self.parameters["log_scales"]),
            logit_opacities=_array(self.parameters["logit_opacities"]),
            sh=sh,
            class_scores=class_scores,
        )

    def state(self) -> dict[str, Tensor]:
        """All that a later process needs to go on to the bit, as plain tensors by name.

        Names are `parameters.X`, `exp_avg.X`, `exp_avg_sq.X`, `step.X`, `rates.X` (float64) and
        `constants.X`; copies, on the CPU. Gradients are not kept: take it between steps.
        """
        state = {f"constants.{name}": value for name, value in self.constants.items()}
        for name, value in self.parameters.items():
            state[f"parameters.{name}"] = value
            for key, kept in self._adam.state[value].items():
                state[f"{key}.{name}"] = kept
        rates = {
            f"rates.{name}": torch.tensor(rate, dtype=torch.float64)
            for name, rate in self.rates.items()
        }
        # A copy even where the tensor is on the CPU already.
        copies = {name: value.detach().cpu().clone() for name, value in state.items()}
        return copies | rates

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Become the pool of `state`, see `of_state`, on this pool's device.

        Raises:
            DataError: If `state` is not what `Pool.state` gives.
        """
        other = Pool.of_state(state, self.parameters["means_m"].device)
        self.parameters, self.constants = other.parameters, other.constants
        self._adam = other._adam

    def _rebuild(self, of_parameter: Any, of_moment: Any) -> None:
        """Put parameters of another length in place of the old ones."""
        for group in self._adam.param_groups:
            name, old = group["name"], group["params"][0]
            memory = self._adam.state.pop(old)
            new = torch.nn.Parameter(of_parameter(name, old))
            for moment in _MOMENTS:
                memory[moment] = of_moment(name, memory[moment])
            self._adam.state[new] = memory
            group["params"] = [new]
            self.parameters[name] = new


_FORMAT = torch.contiguous_format


def _array(tensor: Tensor) -> Any:
    return tensor.detach().cpu().numpy().copy()


def _same_shape(value: Tensor, like: Tensor, name: str) -> Tensor:
    # `copy_` would stretch what fits by broadcasting.
    if value.shape != like.shape:
        raise ValueError(f"{name} must have shape {tuple(like.shape)}, got {tuple(value.shape)}")
    return value


def _check_rows(
    given: Mapping[str, Tensor], kept: Mapping[str, Tensor], count: int, names: Iterable[str]
) -> None:
    if not set(names) == set(given) <= set(kept):
        raise ArgumentError(f"values must be of {sorted(kept)}, got {sorted(given)}")
    for name, value in given.items():
        if value.shape != (count, *kept[name].shape[1:]):
            raise ArgumentError(
                f"{name} must have shape {(count, *kept[name].shape[1:])}, got {tuple(value.shape)}"
            )
