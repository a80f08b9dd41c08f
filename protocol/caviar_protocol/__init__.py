"""What anyone who plugs into CAVIAR must know: messages, payloads, codec, scenarios, recordings."""
