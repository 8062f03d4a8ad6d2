"""Checkpoints and float graphs of the models of psiamfcpp; `psiamfcpp.zoo` finds them."""
