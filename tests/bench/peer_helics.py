"""The exchange of `bench_broker` in HELICS: ``python peer_helics.py SERVICES PAYLOAD FRAMES``.

Prints the seconds that a frame takes. Needs ``pip install helics``.
"""

# ruff: noqa: T201 - the figure is the output

from __future__ import annotations

import subprocess
import sys
import time

WARM_UP = 50


def federate(number: int, services: int, payload: int, frames: int, port: int) -> None:
    """One federate over a ZeroMQ core; number 0 is the hub, which takes what all others publish."""
    import helics as h

    info = h.helicsCreateFederateInfo()
    h.helicsFederateInfoSetCoreTypeFromString(info, "zmq")
    h.helicsFederateInfoSetCoreInitString(
        info, f"--federates=1 --loglevel=none --broker_address=tcp://127.0.0.1:{port}"
    )
    h.helicsFederateInfoSetTimeProperty(info, h.HELICS_PROPERTY_TIME_DELTA, 1.0)
    me = h.helicsCreateValueFederate(f"fed{number}", info)
    mine = h.helicsFederateRegisterGlobalPublication(me, f"pub{number}", h.HELICS_DATA_TYPE_STRING, "")
    sources = range(1, services) if number == 0 else (0,)
    inputs = [h.helicsFederateRegisterSubscription(me, f"pub{source}", "") for source in sources]
    h.helicsFederateEnterExecutingMode(me)
    body, started = bytes(payload), 0.0
    for frame in range(frames + WARM_UP):
        if frame == WARM_UP:
            started = time.perf_counter()
        h.helicsPublicationPublishBytes(mine, body)
        h.helicsFederateRequestTime(me, float(frame + 1))
        for taken in inputs:
            got = h.helicsInputGetBytes(taken)
            assert len(got) == payload, f"frame {frame}: {len(got)} B came, not {payload}"
    if number == 0:
        print("seconds a frame:", (time.perf_counter() - started) / frames, flush=True)
    h.helicsFederateDisconnect(me)
    h.helicsFederateFree(me)
    h.helicsCloseLibrary()


def main() -> None:
    """The broker here, a process for each federate."""
    import helics as h

    arguments = [int(value) for value in sys.argv[1:]]
    if len(arguments) == 5:
        federate(*arguments)
        return
    services, payload, frames = arguments
    port = 24000 + time.monotonic_ns() % 8000
    broker = h.helicsCreateBroker("zmq", "", f"--federates={services} --loglevel=none --port={port}")
    command = [sys.executable, __file__]
    started = [
        subprocess.Popen([*command, *map(str, (number, services, payload, frames, port))])
        for number in range(services)
    ]
    try:
        if any(process.wait(600) for process in started):
            raise SystemExit("a federate failed")
    finally:
        for process in started:
            process.kill()
    h.helicsBrokerDisconnect(broker)
    h.helicsCloseLibrary()


if __name__ == "__main__":
    main()
