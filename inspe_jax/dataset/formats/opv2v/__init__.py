"""OPV2V's format, and its Infra-Set variant."""
