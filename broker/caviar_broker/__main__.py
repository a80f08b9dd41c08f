from caviar_protocol.host import loading

with loading():
    from caviar_broker.launch import main

if __name__ == "__main__":
    raise SystemExit(main())
