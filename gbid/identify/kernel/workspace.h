/* The workspace of this thread. Clang believes that the look-up of a thread's variable leaves half of the vector
   registers as they are, and keeps arguments in them. So the look-up is in a function of its own. */
static workspace *__attribute__((noinline)) workspace_of_thread(void) {
  static __thread workspace w;
  return &w;
}
