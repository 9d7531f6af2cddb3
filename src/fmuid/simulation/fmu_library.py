"""The shared library of an FMU and its instances, by ctypes."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Sequence
from ctypes import CFUNCTYPE, c_bool, c_char_p, c_double, c_int, c_size_t, c_void_p
from pathlib import Path
from typing import Any

from fmuid.core.errors import FmuError, SimulationError
from fmuid.simulation import stepper

_NAMES = {
    "RESET": "Reset",
    "ENTER_INITIALIZATION": "EnterInitializationMode",
    "EXIT_INITIALIZATION": "ExitInitializationMode",
    "TERMINATE": "Terminate",
    "DO_STEP": "DoStep",
    "ENTER_EVENT_MODE": "EnterEventMode",
    "ENTER_CONTINUOUS_TIME_MODE": "EnterContinuousTimeMode",
    "COMPLETED_INTEGRATOR_STEP": "CompletedIntegratorStep",
    "SET_TIME": "SetTime",
    "SET_STATES": "SetContinuousStates",
    "GET_STATES": "GetContinuousStates",
    "GET_INDICATORS": "GetEventIndicators",
    "GET_NOMINALS": "GetNominalsOfContinuousStates",
    "GET_DIRECTIONAL_DERIVATIVE": "GetDirectionalDerivative",
}
_NAMES_OF_VERSION = {
    2: _NAMES
    | {
        "SETUP_EXPERIMENT": "SetupExperiment",
        "SET_INPUT_DERIVATIVES": "SetRealInputDerivatives",
        "GET_BOOLEAN_STATUS": "GetBooleanStatus",
        "UPDATE_DISCRETE_STATES": "NewDiscreteStates",
        "GET_DERIVATIVES": "GetDerivatives",
        "GET_FMU_STATE": "GetFMUstate",
        "SET_FMU_STATE": "SetFMUstate",
        "FREE_FMU_STATE": "FreeFMUstate",
    },
    3: _NAMES
    | {
        "UPDATE_DISCRETE_STATES": "UpdateDiscreteStates",
        "GET_DERIVATIVES": "GetContinuousStateDerivatives",
        "GET_FMU_STATE": "GetFMUState",
        "SET_FMU_STATE": "SetFMUState",
        "FREE_FMU_STATE": "FreeFMUState",
    },
}
_OWN = {  # exported by FMUs of fmu_build in addition to the standard
    "SET_DIRECTIONS": "fmuidSetSensitivityDirections",
    "SET_INPUT_DIRECTIONS": "fmuidSetInputDirections",
    "GET_SENSITIVITIES": "fmuidGetSensitivities",
    "SET_PATIENCE": "fmuidSetPatience",
}
_COMMON = ["ENTER_INITIALIZATION", "EXIT_INITIALIZATION"]
_NEEDED = {  # without RESET, a new instance is made for every run
    False: [*_COMMON, "DO_STEP"],
    True: [
        *_COMMON,
        "ENTER_EVENT_MODE",
        "UPDATE_DISCRETE_STATES",
        "ENTER_CONTINUOUS_TIME_MODE",
        "SET_TIME",
        "SET_STATES",
        "GET_STATES",
        "GET_DERIVATIVES",
    ],
}


class _Callbacks2(ctypes.Structure):
    """fmi2CallbackFunctions."""

    _fields_ = (
        ("logger", c_void_p),
        ("allocate", c_void_p),
        ("free", c_void_p),
        ("step_finished", c_void_p),
        ("environment", c_void_p),
    )


class ProcessSpentError(SimulationError):
    """The FMU can no longer simulate in this process, but could in a new one."""


class Log:
    """The latest messages of FMUs: those of the highest severity since `clear`, from any FMU in this thread."""

    def callback(self, version: int) -> int:
        """Return the address of the C logging function for FMUs of this FMI version."""
        return _address(getattr(stepper.library(), f"fmuid_log_fmi{version}"))

    def clear(self) -> None:
        """Clear the messages."""
        stepper.library().fmuid_clear_log()

    def read(self) -> str:
        """Return the messages, empty if there are none."""
        text = " ".join(stepper.library().fmuid_read_log().decode(errors="replace").split())
        return text if len(text) <= 400 else f"{text[:200]} ... {text[-200:]}"


def _address(function: Any) -> int:
    return ctypes.cast(function, c_void_p).value or 0


class FmuLibrary:
    """The functions of an FMU's shared library.

    Parameters
    ----------
    path
        The shared library.
    version
        FMI major version, 2 or 3.
    model_exchange
        Whether to use model exchange instead of co-simulation.
    where
        Place for error messages.
    """

    def __init__(self, path: Path, version: int, model_exchange: bool, where: Path) -> None:
        self.version, self.model_exchange, self.where = version, model_exchange, where
        self.layouts: dict[tuple[Any, ...], tuple[int, Any, list[Any]]] = {}
        if hasattr(os, "add_dll_directory"):
            os.add_dll_directory(str(path.parent))
        try:
            self._dll = ctypes.CDLL(str(path))
        except OSError as error:
            raise FmuError(
                f"its library cannot be loaded ({error})",
                where=where,
                fix="check that it is built for this machine and that the libraries it needs are installed",
            ) from None
        names = _NAMES_OF_VERSION[version]
        self.functions = (c_void_p * len(stepper.FUNCTIONS))(
            *(
                self.address(names[place]) if place in names else self._symbol(_OWN.get(place))
                for place in stepper.FUNCTIONS
            )
        )
        missing = [
            self.function_name(place)
            for place in _NEEDED[model_exchange]
            if self.functions[stepper.FUNCTIONS.index(place)] is None
        ]
        if missing:
            raise FmuError(f"its library lacks {', '.join(missing)}", where=where, fix="export the FMU again")
        patience = self._symbol(_OWN["SET_PATIENCE"])
        self._set_patience = CFUNCTYPE(None, c_void_p, c_double)(patience) if patience else None
        self.log = Log()
        self._callbacks = _Callbacks2(
            self.log.callback(2),
            # calloc and free directly from C, because an FMU may allocate in every step
            _address(ctypes.pythonapi.PyMem_RawCalloc),
            _address(ctypes.pythonapi.PyMem_RawFree),
            None,
            None,
        )

    def free_state(self, instance: int, state: int) -> None:
        """Free a state that the FMU has given."""
        address = self.functions[stepper.FUNCTIONS.index("FREE_FMU_STATE")]
        ctypes.CFUNCTYPE(c_int, c_void_p, ctypes.POINTER(c_void_p))(address or 0)(instance, c_void_p(state))

    def function_name(self, place: str) -> str:
        """Return the FMI name of the function at `place`."""
        return _OWN.get(place) or f"fmi{self.version}{_NAMES_OF_VERSION[self.version].get(place, place)}"

    def address(self, name: str) -> int | None:
        """Return the address of ``fmi2<name>`` or ``fmi3<name>``, None if the library lacks it."""
        return self._symbol(f"fmi{self.version}{name}")

    def _symbol(self, name: str | None) -> int | None:
        try:
            return _address(getattr(self._dll, name)) if name else None
        except AttributeError:
            return None

    def instantiate(self, name: str, token: str, resources: Path) -> int:
        """Return a new instance.

        Raises
        ------
        FmuError
            The FMU refuses; the message contains its log.
        """
        self.log.clear()
        if self.version == 2:
            arguments: list[tuple[type, Any]] = [
                (c_char_p, name.encode()),
                (c_int, 0 if self.model_exchange else 1),
                (c_char_p, token.encode()),
                (c_char_p, resources.as_uri().encode()),
                (c_void_p, ctypes.addressof(self._callbacks)),
                (c_int, 0),
                (c_int, 0),
            ]
            function = "Instantiate"
        else:
            arguments = [
                (c_char_p, name.encode()),
                (c_char_p, token.encode()),
                (c_char_p, f"{resources}{os.path.sep}".encode()),
                (c_bool, False),
                (c_bool, False),
            ]
            if not self.model_exchange:  # neither event mode nor early return: the FMU handles its own events
                arguments += [(c_bool, False), (c_bool, False), (c_void_p, None), (c_size_t, 0)]
            arguments += [(c_void_p, None), (c_void_p, self.log.callback(3))]
            if not self.model_exchange:
                arguments.append((c_void_p, None))
            function = "InstantiateModelExchange" if self.model_exchange else "InstantiateCoSimulation"
        address = self.address(function)
        if address is None:
            raise FmuError(
                f"its library lacks fmi{self.version}{function}", where=self.where, fix="export the FMU again"
            )
        call: Callable[..., int | None] = CFUNCTYPE(c_void_p, *(kind for kind, _ in arguments))(address)
        instance = call(*(value for _, value in arguments))
        if not instance:
            logged = self.log.read()
            raise FmuError(
                f"cannot be instantiated{': ' + logged if logged else ' and gives no reason'}",
                where=self.where,
                fix="check whether its tool or FMPy can run it",
            )
        return instance

    def takes_directions(self, instance: int, references: Sequence[int]) -> bool:
        """Return whether a new instance differentiates its runs with respect to these parameters."""
        address = self._symbol(_OWN["SET_DIRECTIONS"])
        if address is None or self.model_exchange:
            return False
        n = len(references)
        moved, weights = (ctypes.c_uint32 * n)(*references), (ctypes.c_double * n)(*[1.0] * n)
        function = CFUNCTYPE(c_int, c_void_p, c_void_p, c_size_t, c_void_p, c_size_t)(address)
        return int(function(instance, moved, n, weights, 1)) <= 1

    def limit(self, instance: int, patience: stepper.Patience, n_times: int) -> None:
        """Let a communication step take at most a run's processor time, if the FMU can look at the clock."""
        if self._set_patience is not None:
            self._set_patience(instance, patience.of_run(n_times))

    def free(self, instance: int) -> None:
        """Free an instance."""
        address = self.address("FreeInstance")
        if address is not None:
            CFUNCTYPE(None, c_void_p)(address)(instance)
