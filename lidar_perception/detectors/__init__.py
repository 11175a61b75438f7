"""From a cloud to boxes: one contract, and every detector that fulfils it."""
