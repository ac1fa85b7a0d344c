"""What shipped numbers rest on: how they were found, a second model beside the first; not shipped itself."""
