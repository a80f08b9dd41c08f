"""How much of the scenery is traced: small and far pieces left out, the rest of fewer triangles."""
