"""Stage 4: act on it. The policy-gradient core and the learners built on it."""
