"""Programs of the checkout: setting up, the vocabulary, the reference pages."""
