"""The protocol of CAVIAR: messages, payloads, codec, scenarios, recordings."""
