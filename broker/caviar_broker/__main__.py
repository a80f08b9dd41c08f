import gc

gc.disable()  # looking for garbage, which loading leaves none of, takes a tenth of the time

from caviar_broker.launch import main  # noqa: E402  # after what saves time

gc.enable()
if __name__ == "__main__":
    raise SystemExit(main())
