"""OPV2V's folders and its Infra-Set variant."""
