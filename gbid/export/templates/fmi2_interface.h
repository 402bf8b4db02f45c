/* Declarations of FMI 2.0 for co-simulation that this unit uses, written after the standard (FMI 2.0.4, sections
   2.1 and 4.2). Names, types and the order of the entries are those of the standard, so that any importer can call. */
#ifndef GBID_FMI2_INTERFACE_H
#define GBID_FMI2_INTERFACE_H

#include <stddef.h>

typedef void *fmi2Component;
typedef void *fmi2ComponentEnvironment;
typedef void *fmi2FMUstate;
typedef unsigned int fmi2ValueReference;
typedef double fmi2Real;
typedef int fmi2Integer;
typedef int fmi2Boolean;
typedef char fmi2Char;
typedef const fmi2Char *fmi2String;
typedef char fmi2Byte;

#define fmi2True 1
#define fmi2False 0

typedef enum { fmi2OK, fmi2Warning, fmi2Discard, fmi2Error, fmi2Fatal, fmi2Pending } fmi2Status;
typedef enum { fmi2ModelExchange, fmi2CoSimulation } fmi2Type;
typedef enum { fmi2DoStepStatus, fmi2PendingStatus, fmi2LastSuccessfulTime, fmi2Terminated } fmi2StatusKind;

typedef struct {
    void (*logger)(fmi2ComponentEnvironment, fmi2String, fmi2Status, fmi2String, fmi2String, ...);
    void *(*allocateMemory)(size_t, size_t);
    void (*freeMemory)(void *);
    void (*stepFinished)(fmi2ComponentEnvironment, fmi2Status);
    fmi2ComponentEnvironment componentEnvironment;
} fmi2CallbackFunctions;

/* Names begin with FMI2_FUNCTION_PREFIX when several units are linked into one program. */
#ifdef FMI2_FUNCTION_PREFIX
#define GBID_JOIN_(a, b) a##b
#define GBID_JOIN(a, b) GBID_JOIN_(a, b)
#define GBID_FMI2(name) GBID_JOIN(FMI2_FUNCTION_PREFIX, name)
#else
#define GBID_FMI2(name) name
#endif

#if defined(_WIN32) || defined(__CYGWIN__)
#define GBID_EXPORT __declspec(dllexport)
#elif defined(__GNUC__)
#define GBID_EXPORT __attribute__((visibility("default")))
#else
#define GBID_EXPORT
#endif

#endif
