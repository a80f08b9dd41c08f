"""Verification of a dataset, ``caviar dataset verify``: what is missing, altered, or against physics.

`verify` goes through the dataset; `catalogue_checks` compares files with the catalogue, `recording_checks`
looks at what each recording has to have, and `physics` at the content of its scenes, of which `path_checks`
judges paths and H, and `beam_checks` beams and SNRs. `findings` are what they find.
"""
