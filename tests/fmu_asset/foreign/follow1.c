#include "follow2.c"
