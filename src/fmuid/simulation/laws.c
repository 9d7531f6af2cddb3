/* See laws.h. */
#include "laws.h"

#include <inttypes.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

typedef struct { const Laws *laws; size_t n_own; const double *input, *x, *plain; double t; } Point;

static double value_of(const Program *program, const Point *at)
{
    double stack[DEEPEST], *top = stack - 1;
    for (size_t i = 0; i < program->n; i++) {
        const Instruction *now = program->code + i;
        if (now->operation >= ADD && now->operation <= ATAN2) {
            double b = *top--, a = *top;
            switch (now->operation) {
            case ADD: *top = a + b; break;
            case SUBTRACT: *top = a - b; break;
            case MULTIPLY: *top = a * b; break;
            case DIVIDE: *top = a / b; break;
            case POWER: *top = pow(a, b); break;
            case LESS: *top = a < b; break;
            case AT_MOST: *top = a <= b; break;
            case EQUAL: *top = a == b; break;
            case AND: *top = a != 0 && b != 0; break;
            case OR: *top = a != 0 || b != 0; break;
            case MINIMUM: *top = a < b ? a : b; break;
            case MAXIMUM: *top = a > b ? a : b; break;
            default: *top = atan2(a, b);
            }
            continue;
        }
        switch (now->operation) {
        case CONSTANT: *++top = now->value; break;
        case STATE: *++top = at->x[now->index]; break;
        case DERIVATIVE: *++top = at->plain[now->index]; break;
        case INPUT: *++top = at->input[now->index]; break;
        case PARAMETER: *++top = at->laws->parameter[now->index]; break;
        case TIME: *++top = at->t; break;
        case OWN: *++top = at->laws->coefficient[now->index].own; break;
        case ADDED_STATE: *++top = at->x[at->n_own + at->laws->place[now->index]]; break;
        case NEGATE: *top = -*top; break;
        case NOT: *top = *top == 0; break;
        case ABS: *top = fabs(*top); break;
        case SIGN: *top = (*top > 0) - (*top < 0); break;
        case SQRT: *top = sqrt(*top); break;
        case EXP: *top = exp(*top); break;
        case LOG: *top = log(*top); break;
        case LOG10: *top = log10(*top); break;
        case SIN: *top = sin(*top); break;
        case COS: *top = cos(*top); break;
        case TAN: *top = tan(*top); break;
        case ASIN: *top = asin(*top); break;
        case ACOS: *top = acos(*top); break;
        case ATAN: *top = atan(*top); break;
        case SINH: *top = sinh(*top); break;
        case COSH: *top = cosh(*top); break;
        case TANH: *top = tanh(*top); break;
        case JUMP: i = (size_t)now->index - 1; break;
        default: /* UNLESS */
            if (*top-- == 0) i = (size_t)now->index - 1;
        }
    }
    return *top;
}

static Point point(const Plan *plan, const double *input, double t, const double *x)
{
    const Laws *laws = &((const PlanWithLaws *)plan)->laws;
    return (Point){laws, laws->n_states, input, x, laws->plain, t};
}

size_t added_states(const Plan *plan) { return ((const PlanWithLaws *)plan)->n_added; }

bool parameters_vary(const Plan *plan)
{
    const Laws *laws = &((const PlanWithLaws *)plan)->laws;
    for (size_t i = 0; i < laws->n_coefficients; i++)
        if (laws->coefficient[i].active) return true;
    return false;
}

/* Derivatives of the instances of a coefficient at a point. */
static int32_t look_aside(Plan *plan, const Coefficient *coefficient, const Point *at)
{
    for (int i = 0; i < 2; i++) {
        Plan aside = *plan;
        aside.instance = coefficient->instance[i];
        int32_t outcome = derivatives_at(&aside, at->input, at->t, at->x, at->n_own, coefficient->f[i]);
        plan->call = aside.call, plan->status = aside.status;
        TRY(outcome);
    }
    return DONE;
}

/* The quotient of lines through three points, at p. */
static double between(const double p[3], const double f[3], double at)
{
    double first = f[1] - f[0], second = f[1] - f[2], size = fabs(f[0]) + fabs(f[1]) + fabs(f[2]);
    if (fabs(first) + fabs(second) <= 1e-13 * size || at == p[0]) return f[0];
    if (at == p[2]) return f[2];
    if (second == 0) return f[0] + (at - p[0]) * first / (p[1] - p[0]);
    double ratio = (at - p[0]) * (p[1] - p[2]) / ((at - p[2]) * (p[1] - p[0])) * first / second;
    return f[0] + ratio * (f[0] - f[2]) / (1 - ratio);
}

int32_t add_laws(Plan *plan, const double *input, double t, const double *x, double *f)
{
    const Point at = point(plan, input, t, x);
    const Laws *laws = at.laws;
    memcpy(laws->plain, f, at.n_own * sizeof *f);
    for (const Coefficient *one = laws->coefficient; one < laws->coefficient + laws->n_coefficients; one++)
        if (one->active) TRY(look_aside(plan, one, &at));
    for (const Law *law = laws->law; law < laws->law + laws->n_laws; law++) {
        if (!law->active) continue;
        if (law->coefficient != NONE) {
            const Coefficient *c = laws->coefficient + law->coefficient;
            const double p[3] = {c->own, c->at[0], c->at[1]}, value = value_of(&law->term[0].flow, &at);
            for (size_t i = 0; i < at.n_own; i++)
                f[i] += between(p, (const double[3]){laws->plain[i], c->f[0][i], c->f[1][i]}, value) - laws->plain[i];
        } else
            for (size_t i = 0; i < law->n_terms; i++) f[law->term[i].target] -= value_of(&law->term[i].flow, &at);
        for (size_t i = 0; i < law->n_inner; i++) f[at.n_own + law->inner[i].place] = value_of(&law->inner[i].derivative, &at);
    }
    return DONE;
}

void start_laws(const Plan *plan, const double *input, double t, double *x)
{
    const Point at = point(plan, input, t, x);
    for (const Law *law = at.laws->law; law < at.laws->law + at.laws->n_laws; law++)
        for (size_t i = 0; law->active && i < law->n_inner; i++)
            x[at.n_own + law->inner[i].place] = value_of(&law->inner[i].start, &at);
}

bool has_directions(const Plan *plan) { return ((const PlanWithLaws *)plan)->n_directions > 0; }

/* The plan of a direction's instance. It shares the scratch of the other one. */
PlanWithLaws aside_of(const Plan *plan, const Direction *direction)
{
    PlanWithLaws aside = *(const PlanWithLaws *)plan;
    aside.plan.instance = direction->instance;
    aside.laws.parameter = direction->parameter;
    aside.n_directions = 0;
    return aside;
}

/* A law is also active if it is only on in one of the directions. */
size_t activate_laws(Laws *laws, const Direction *directions, size_t n_directions)
{
    size_t n = 0, number = 0;
    for (size_t i = 0; i < laws->n_coefficients; i++) laws->coefficient[i].active = 0;
    for (Law *law = laws->law; law < laws->law + laws->n_laws; law++) {
        law->active = law->n_sizes == 0;
        for (size_t i = 0; i < law->n_sizes; i++) {
            law->active |= laws->parameter[law->size[i]] != law->neutral[i];
            for (size_t d = 0; d < n_directions; d++)
                law->active |= directions[d].parameter[law->size[i]] != law->neutral[i];
        }
        if (law->active && law->coefficient != NONE) laws->coefficient[law->coefficient].active = 1;
        for (size_t i = 0; i < law->n_inner; i++, number++)
            if (law->active) law->inner[i].place = laws->place[number] = n++;
    }
    return n;
}

/* ---- The file: numbers only. A damaged one is refused, for programs are not checked when they run. ---- */

static int read_size(FILE *file, size_t most, size_t *value) { return fscanf(file, "%zu", value) == 1 && *value <= most; }

/* The bits of a double in hexadecimal, which no locale misreads. */
int read_double(FILE *file, double *value)
{
    uint64_t bits;
    if (fscanf(file, "%" SCNx64, &bits) != 1) return 0;
    memcpy(value, &bits, sizeof bits);
    return 1;
}

static int read_program(Program *program, FILE *file, const Laws *laws)
{
    if (!read_size(file, 10000, &program->n) || program->n == 0) return 0;
    program->code = calloc(program->n, sizeof *program->code);
    if (!program->code) return 0;
    int depth = 0;
    for (Instruction *now = program->code; now < program->code + program->n; now++) {
        if (fscanf(file, "%" SCNd32 " %" SCNd32, &now->operation, &now->index) != 2 || !read_double(file, &now->value))
            return 0;
        int op = now->operation;
        if (op < 0 || op >= N_OPERATIONS || now->index < 0) return 0;
        size_t index = (size_t)now->index;
        if ((op == STATE || op == DERIVATIVE) && index >= laws->n_states) return 0;
        if (op == PARAMETER && index >= laws->n_parameters) return 0;
        if (op == ADDED_STATE && index >= laws->n_inner) return 0;
        if (op == OWN && index >= laws->n_coefficients) return 0;
        if ((op == JUMP || op == UNLESS) && (index > program->n || index <= (size_t)(now - program->code))) return 0;
        /* Of the two ways of an `if`, each leaves one value; the second begins after the first has been counted. */
        depth += op < ADD ? 1 : (op <= ATAN2 || op == UNLESS || op == JUMP) ? -1 : 0;
        if (depth < 0 || depth > DEEPEST || (depth == 0 && op != UNLESS && op != JUMP)) return 0;
    }
    return depth == 1;
}

int read_laws(Laws *laws, FILE *file, size_t n_states, size_t n_scalars)
{
    laws->n_states = n_states;
    if (!read_size(file, 100000, &laws->n_parameters) || !read_size(file, 100000, &laws->n_inner) ||
        !read_size(file, 100000, &laws->n_laws) || !read_size(file, 100000, &laws->n_coefficients))
        return 0;
    laws->coefficient = calloc(laws->n_coefficients + 1, sizeof(Coefficient));
    for (size_t i = 0; laws->coefficient && i < laws->n_coefficients; i++) {
        Coefficient *one = laws->coefficient + i;
        one->f[0] = calloc(n_states + 1, sizeof(double)), one->f[1] = calloc(n_states + 1, sizeof(double));
        if (!one->f[0] || !one->f[1] || !read_size(file, n_scalars - 1, &one->scalar)) return 0;
    }
    laws->parameter = calloc(laws->n_parameters + 1, sizeof(double));
    laws->place = calloc(laws->n_inner + 1, sizeof(size_t));
    laws->plain = calloc(n_states + 1, sizeof(double));
    laws->law = calloc(laws->n_laws + 1, sizeof(Law));
    if (!laws->parameter || !laws->place || !laws->plain || !laws->law || !laws->coefficient) return 0;
    size_t inner = 0;
    for (Law *law = laws->law; law < laws->law + laws->n_laws; law++) {
        if (!read_size(file, laws->n_parameters, &law->n_sizes) || !read_size(file, n_states, &law->n_terms) ||
            !read_size(file, laws->n_inner - inner, &law->n_inner) || !read_size(file, laws->n_coefficients, &law->coefficient))
            return 0;
        law->coefficient = law->coefficient ? law->coefficient - 1 : NONE; /* counted from one, zero: none */
        if (law->coefficient != NONE && law->n_terms != 1) return 0;
        inner += law->n_inner;
        law->size = calloc(law->n_sizes + 1, sizeof *law->size);
        law->neutral = calloc(law->n_sizes + 1, sizeof *law->neutral);
        law->term = calloc(law->n_terms + 1, sizeof *law->term);
        law->inner = calloc(law->n_inner + 1, sizeof *law->inner);
        if (!law->size || !law->neutral || !law->term || !law->inner) return 0;
        for (size_t i = 0; i < law->n_sizes; i++)
            if (!read_size(file, laws->n_parameters - 1, &law->size[i]) || !read_double(file, &law->neutral[i]))
                return 0;
        for (size_t i = 0; i < law->n_terms; i++)
            if (!read_size(file, n_states - 1, &law->term[i].target) || !read_program(&law->term[i].flow, file, laws))
                return 0;
        for (size_t i = 0; i < law->n_inner; i++)
            if (!read_program(&law->inner[i].derivative, file, laws) || !read_program(&law->inner[i].start, file, laws))
                return 0;
    }
    return inner == laws->n_inner;
}

void free_laws(Laws *laws)
{
    for (Law *law = laws->law; law && law < laws->law + laws->n_laws; law++) {
        for (size_t i = 0; law->term && i < law->n_terms; i++) free(law->term[i].flow.code);
        for (size_t i = 0; law->inner && i < law->n_inner; i++)
            free(law->inner[i].derivative.code), free(law->inner[i].start.code);
        free(law->size), free(law->neutral), free(law->term), free(law->inner);
    }
    for (size_t i = 0; laws->coefficient && i < laws->n_coefficients; i++)
        free(laws->coefficient[i].f[0]), free(laws->coefficient[i].f[1]);
    free(laws->coefficient), free(laws->law), free(laws->parameter), free(laws->place), free(laws->plain);
}
