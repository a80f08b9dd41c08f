import gc
import signal

if __name__ == "__main__" and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    # Ctrl-C while the libraries load ends the process without a traceback; then `serve` handles it.
    signal.signal(signal.SIGINT, signal.SIG_DFL)

from caviar_protocol.host import loading

with loading():
    from caviar_services.runner import main

gc.freeze()  # what is loaded stays: no collection looks at it, nor the end of the process
if __name__ == "__main__":
    raise SystemExit(main())
