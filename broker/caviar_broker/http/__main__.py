from caviar_broker.http.process import main

if __name__ == "__main__":
    raise SystemExit(main())
