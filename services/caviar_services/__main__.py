import gc
import signal

if __name__ == "__main__" and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    # Ctrl-C while the libraries load ends the process without a traceback; then `serve` handles it.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
gc.disable()  # looking for garbage, which loading leaves none of, takes a tenth of the time

from caviar_services.runner import main  # noqa: E402  # after what saves time

gc.enable()
if __name__ == "__main__":
    raise SystemExit(main())
