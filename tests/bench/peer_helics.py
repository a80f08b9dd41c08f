"""The exchange of `bench_broker` in HELICS: ``python peer_helics.py SERVICES PAYLOAD FRAMES [lagged]``.

The hub steps half a frame after the others: it takes what they made in this frame, and they take in the next
what it made of that. With ``lagged`` it steps with them and takes what they made in the frame before, which
depends on less and lets all of them work at a time.

Prints the seconds that a frame takes. Needs ``pip install helics``.
"""

# ruff: noqa: T201 - the figure is the output

from __future__ import annotations

import subprocess
import sys
import time

WARM_UP = 50


def federate(number: int, services: int, payload: int, frames: int, lagged: int, port: int) -> None:
    """One federate over a ZeroMQ core; number 0 is the hub, which takes what all others publish."""
    import helics as h

    info = h.helicsCreateFederateInfo()
    h.helicsFederateInfoSetCoreTypeFromString(info, "zmq")
    h.helicsFederateInfoSetCoreInitString(
        info, f"--federates=1 --loglevel=none --broker_address=tcp://127.0.0.1:{port}"
    )
    behind = 0.5 if number == 0 and not lagged else 0.0
    h.helicsFederateInfoSetTimeProperty(info, h.HELICS_PROPERTY_TIME_PERIOD, 1.0)
    h.helicsFederateInfoSetTimeProperty(info, h.HELICS_PROPERTY_TIME_OFFSET, behind)
    me = h.helicsCreateValueFederate(f"fed{number}", info)
    mine = h.helicsFederateRegisterGlobalPublication(me, f"pub{number}", h.HELICS_DATA_TYPE_STRING, "")
    sources = range(1, services) if number == 0 else (0,)
    inputs = [h.helicsFederateRegisterSubscription(me, f"pub{source}", "") for source in sources]
    h.helicsFederateEnterExecutingMode(me)
    body, started = bytes(payload), 0.0
    for frame in range(frames + WARM_UP):
        if frame == WARM_UP:
            started = time.perf_counter()
        # Who took the right values in the warm-up does so later, and then nothing is spent on showing it.
        made = (b"%d" % (frame % 10)).ljust(payload)[:payload] if frame < WARM_UP else body
        if not behind:
            h.helicsPublicationPublishBytes(mine, made)
        until = frame + (behind or 1.0)
        now = h.helicsFederateRequestTime(me, until)
        assert now == until, f"frame {frame}: {now} granted, not {until}"
        for taken in inputs:
            got = h.helicsInputGetBytes(taken)
            assert len(got) == payload, f"frame {frame}: {len(got)} B came, not {payload}"
            assert frame >= WARM_UP or got == made, f"frame {frame}: {got!r} came, not {made!r}"
        if behind:
            h.helicsPublicationPublishBytes(mine, made)
    if number == 0:
        print("seconds a frame:", (time.perf_counter() - started) / frames, flush=True)
    h.helicsFederateDisconnect(me)
    h.helicsFederateFree(me)
    h.helicsCloseLibrary()


def main() -> None:
    """The broker here, a process for each federate."""
    import helics as h

    if sys.argv[1] == "--federate":
        federate(*map(int, sys.argv[2:]))
        return
    services, payload, frames = map(int, sys.argv[1:4])
    lagged = int("lagged" in sys.argv[4:])
    port = 24000 + time.monotonic_ns() % 8000
    broker = h.helicsCreateBroker("zmq", "", f"--federates={services} --loglevel=none --port={port}")
    command = [sys.executable, __file__, "--federate"]
    started = [
        subprocess.Popen([*command, *map(str, (number, services, payload, frames, lagged, port))])
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
