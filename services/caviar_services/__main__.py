from caviar_services.runner import main

if __name__ == "__main__":
    raise SystemExit(main())
